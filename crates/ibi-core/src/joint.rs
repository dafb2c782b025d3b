//! The joint check: all accepted poses compete for the target at once.
//!
//! In the rounds the earlier pose claims first. At the end every scene point goes to the pose nearest to it, so
//! that a wrong early pose cannot live on what belongs to a right later one.

use crate::correspondence::Alive;
use crate::kernels::evidence::Support;
use crate::kernels::par;
use crate::params::Params;
use crate::scene::Detail;
use crate::stages::{Context, Validate, Verdict};
use crate::state::{Found, Problem};

/// What `ask` answers of an instance where only that is free which no other one is nearer to. `context` is that of all
/// correspondences and all instances.
fn alone<T>(context: &Context<'_>, instance: usize, found: &Found, ask: impl FnOnce(&Context<'_>) -> T) -> T {
    let claims = context.claims.against(instance);
    let near = claims.near(found.pose());
    if near.is_empty() {
        return ask(&Context { claims, ..*context });
    }
    let around = context.around(2.0 * context.params.d_op_pr, found.pose());
    let rows: Vec<u32> = around.iter().map(|&id| context.pairs.target_rows[id as usize]).collect();
    let claimed = around.iter().zip(near.contain(&rows)).filter(|&(_, is_claimed)| is_claimed);
    let claimed: Vec<u32> = claimed.map(|(&id, _)| id).collect();
    let mut alive = Alive::all(context.pairs);
    alive.remove(&claimed);
    ask(&Context { claims, alive: &alive, ..*context })
}

/// What speaks for each instance where they do not compete.
pub(crate) fn supports(problem: &Problem<'_>, params: &Params, found: &[Found]) -> Vec<Support> {
    let everything = Alive::all(&problem.pairs);
    let context = problem.context_of(params, 0, &everything, found);
    context.chance(); // not from within the map
    par::map(found.len(), 1, |at| context.support(Detail::Look, found[at].pose(), false))
}

/// Drops the poses that fail validation on what is their own, the worst first; returns what speaks for each of the others.
pub(crate) fn joint_check(
    problem: &Problem<'_>,
    params: &Params,
    hv: &dyn Validate,
    found: &mut Vec<Found>,
) -> Vec<Support> {
    let everything = Alive::all(&problem.pairs);
    let mut measured: Vec<Option<Own>> = vec![None; found.len()];
    loop {
        let context = problem.context_of(params, 0, &everything, found);
        context.chance(); // not from within the map
        let all = par::map(found.len(), 1, |at| {
            measured[at]
                .unwrap_or_else(|| alone(&context, at, &found[at], |own| Own::new(own, hv, &found[at])))
        });
        let failed = all.iter().enumerate().filter_map(|(at, own)| {
            let Verdict { value, threshold } = own.verdict.filter(|verdict| !verdict.accepted())?;
            Some((at, value - threshold))
        });
        let Some((worst, _)) = failed.min_by(|(_, a), (_, b)| a.total_cmp(b)) else {
            return all.into_iter().map(|own| own.support).collect();
        };
        measured = all.into_iter().map(Some).collect();
        measured.remove(worst);
        let dropped = found.remove(worst);
        for (own, found) in measured.iter_mut().zip(&*found) {
            if problem.are_near(params, found.pose(), dropped.pose()) {
                *own = None;
            }
        }
    }
}

/// What an instance is worth on what is its own.
#[derive(Clone, Copy)]
struct Own {
    support: Support,
    /// None where no other instance is near: it stays as when it was accepted.
    verdict: Option<Verdict>,
}

impl Own {
    fn new(context: &Context<'_>, hv: &dyn Validate, found: &Found) -> Self {
        let support = context.support(Detail::Look, found.pose(), true);
        let is_disputed = !context.claims.near(found.pose()).is_empty();
        let verdict = || hv.verdict_of(&support).unwrap_or_else(|| hv.validate(context, &found.hypothesis));
        Self { support, verdict: is_disputed.then(verdict) }
    }
}
