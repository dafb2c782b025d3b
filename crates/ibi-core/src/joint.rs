//! The joint check: all accepted poses compete for the target at once.
//!
//! In the rounds the earlier pose claims first. At the end every scene point goes to the pose nearest to it, so
//! that a wrong early pose cannot live on what belongs to a right later one.

use crate::correspondence::Alive;
use crate::kernels::par;
use crate::params::Params;
use crate::stages::{Context, Validate};
use crate::state::{Found, Problem};

/// What `ask` answers of an instance where only that is free which no other one is nearer to. `context` is that of all
/// correspondences and all instances.
pub(crate) fn alone<T>(
    context: &Context<'_>,
    instance: usize,
    found: &Found,
    ask: impl FnOnce(&Context<'_>) -> T,
) -> T {
    let claims = context.claims.against(instance);
    let near = claims.near(found.pose());
    if near.is_empty() {
        return ask(&Context { claims, ..*context });
    }
    let around: Vec<u32> = context.around(2.0 * context.params.d_op_pr, found.pose()).collect();
    let rows: Vec<u32> = around.iter().map(|&id| context.pairs.target_rows[id as usize]).collect();
    let claimed = around.iter().zip(near.contain(&rows)).filter(|&(_, is_claimed)| is_claimed);
    let claimed: Vec<u32> = claimed.map(|(&id, _)| id).collect();
    let mut alive = Alive::all(context.pairs);
    alive.remove(&claimed);
    ask(&Context { claims, alive: &alive, ..*context })
}

/// Drops the poses that fail validation on what is their own, the worst first.
pub(crate) fn joint_check(problem: &Problem<'_>, params: &Params, hv: &dyn Validate, found: &mut Vec<Found>) {
    let everything = Alive::all(&problem.pairs);
    while found.len() > 1 {
        let context = problem.context_of(params, 0, &everything, found);
        context.chance(); // not from within the map
        let margins = par::map(found.len(), 1, |at| {
            let instance = &found[at];
            if context.claims.against(at).near(instance.pose()).is_empty() {
                return None; // as when it was accepted
            }
            let verdict = alone(&context, at, instance, |own| hv.validate(own, &instance.hypothesis));
            (!verdict.accepted()).then_some((at, verdict.value - verdict.threshold))
        });
        let Some((worst, _)) = margins.into_iter().flatten().min_by(|(_, a), (_, b)| a.total_cmp(b)) else {
            return;
        };
        found.remove(worst);
    }
}
