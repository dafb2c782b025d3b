//! The joint check: all accepted poses compete for the target at once.
//!
//! In the rounds the earlier pose claims first. At the end every scene point goes to the pose nearest to it, so
//! that a wrong early pose cannot live on what belongs to a right later one.

use std::sync::Mutex;

use nalgebra::Point3;

use crate::claims::are_near;
use crate::correspondence::Alive;
use crate::finish::Grace;
use crate::interrupt::Phase;
use crate::kernels::evidence::Support;
use crate::kernels::par;
use crate::ledger::Ledger;
use crate::params::Params;
use crate::scene::Detail;
use crate::stages::{Context, Validate, Verdict};
use crate::state::{Found, Problem};

/// What `ask` answers of an instance where only that is free which no other one is nearer to. `context` is that of all
/// correspondences and all instances.
fn alone<T>(
    context: &Context<'_>,
    ledger: &Ledger<'_>,
    instance: usize,
    found: &Found,
    ask: impl FnOnce(&Context<'_>) -> T,
) -> T {
    let claims = context.claims.against(instance, ledger);
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

/// What speaks for each instance where they do not compete. Those for which there is no time are dropped.
pub(crate) fn supports(
    problem: &Problem<'_>,
    params: &Params,
    found: &mut Vec<Found>,
    grace: &mut Grace<'_>,
) -> Vec<Support> {
    problem.interrupt.begin(Phase::JointCheck);
    let everything = Alive::all(&problem.pairs);
    let context = problem.context_of(params, 0, &everything, found);
    let cost = problem.cost_of_look(params);
    let supports =
        grace.map(found.len(), |_| cost, |at| context.support(Detail::Look, found[at].pose(), false));
    let mut is_kept = supports.iter().map(Option::is_some).collect::<Vec<bool>>().into_iter();
    found.retain(|_| is_kept.next().unwrap_or_default());
    supports.into_iter().flatten().collect()
}

/// Drops the poses that fail validation on what is their own, the worst first; returns what speaks for each of the others.
///
/// Once the run is ended and the time for this is over, all that fail go at once, and so do those that have not been measured
/// yet; the others keep what spoke for them among all: less than there would be without those.
pub(crate) fn joint_check(
    problem: &Problem<'_>,
    params: &Params,
    hv: &dyn Validate,
    found: &mut Vec<Found>,
    grace: &mut Grace<'_>,
) -> Vec<Support> {
    problem.interrupt.begin(Phase::JointCheck);
    let everything = Alive::all(&problem.pairs);
    let mut measured: Vec<Option<Own>> = {
        let context = problem.context_of(params, 0, &everything, found);
        Check { problem, params, hv, context, found, cost: problem.cost_of(params, hv) }.run(grace)
    };
    let mut is_kept = measured.iter().map(Option::is_some).collect::<Vec<bool>>().into_iter();
    found.retain(|_| is_kept.next().unwrap_or_default());
    measured.drain(..).flatten().map(|own| own.support).collect()
}

/// Where no pose is near more others than this each is asked for each, which is quicker than a ledger of so few.
const FEW_NEAR: usize = 16;

struct Check<'a> {
    problem: &'a Problem<'a>,
    params: &'a Params,
    hv: &'a dyn Validate,
    context: Context<'a>,
    found: &'a [Found],
    /// Of measuring one.
    cost: usize,
}

impl Check<'_> {
    /// What is left, and what it is worth.
    fn run(&self, grace: &mut Grace<'_>) -> Vec<Option<Own>> {
        let Self { problem, params, found, .. } = *self;
        let scene = &problem.scene;
        let poses = found.iter().map(|found| *found.pose()).collect();
        let centres: Vec<Point3<f64>> =
            found.iter().map(|found| found.pose() * scene.source.centre).collect();
        let are_near =
            |a: usize, b: usize| a != b && are_near(scene, params.d_op_pr, found[a].pose(), &centres[b]);
        let mut num_near =
            par::map(found.len(), 256, |a| (0..found.len()).filter(|&b| are_near(b, a)).count());
        let mut ledger = Ledger::new(scene, params.d_op_pr, poses);
        let disputed: Vec<usize> = (0..found.len()).filter(|&at| num_near[at] > 0).collect();
        let are_many = num_near.iter().any(|&num| num > FEW_NEAR);
        if are_many {
            let rows = grace.map(disputed.len(), |_| self.cost, |i| self.rows(&found[disputed[i]]));
            ledger.enter(rows.into_iter().flatten().flatten(), &disputed, self.cost, grace);
        }
        // Correspondences need not be points of the clouds: then a row may matter to an instance that is far from it.
        let asks_all = !are_many || !problem.pairs.are_rows || !self.hv.is_repeatable();
        let mut measured: Vec<Option<Own>> = vec![None; found.len()];
        let mut is_stale: Vec<bool> = (0..found.len()).map(|at| ledger.holds(at)).collect();
        loop {
            let stale: Vec<usize> = (0..found.len()).filter(|&at| is_stale[at]).collect();
            let anew = grace.map(
                stale.len(),
                |_| self.cost,
                |i| {
                    let at = stale[i];
                    alone(&self.context, &ledger, at, &found[at], |own| Own::new(own, self.hv, &found[at]))
                },
            );
            let is_complete = anew.iter().all(Option::is_some);
            for (at, own) in stale.into_iter().zip(anew) {
                measured[at] = own.or(measured[at]);
            }
            is_stale.fill(false);
            let failed = measured.iter().enumerate().filter_map(|(at, own)| {
                let Verdict { value, threshold } = (*own)?.verdict.filter(|verdict| !verdict.accepted())?;
                Some((at, value - threshold))
            });
            if !is_complete {
                let failed: Vec<usize> = failed.map(|(at, _)| at).collect();
                for at in failed {
                    measured[at] = None;
                }
                return measured;
            }
            let Some((worst, _)) = failed.min_by(|(_, a), (_, b)| a.total_cmp(b)) else { return measured };
            measured[worst] = None;
            ledger.take_out(worst, |at| is_stale[at] = true);
            for at in (0..found.len()).filter(|&at| measured[at].is_some()) {
                if are_near(at, worst) {
                    num_near[at] -= 1;
                    is_stale[at] |= num_near[at] == 0;
                }
                is_stale[at] |= asks_all && problem.are_near(params, found[at].pose(), found[worst].pose());
            }
            for at in 0..found.len() {
                is_stale[at] &= measured[at].is_some();
            }
        }
    }

    /// The rows of the target that will be asked for an instance.
    fn rows(&self, found: &Found) -> Vec<u32> {
        let Self { problem, params, context, .. } = self;
        let around = context.around(2.0 * params.d_op_pr, found.pose());
        let rows: Vec<u32> = around.iter().map(|&id| problem.pairs.target_rows[id as usize]).collect();
        let rows = Mutex::new(rows);
        let _ = problem.scene.fit(params, Detail::Look, found.pose(), |asked| {
            if let Ok(mut rows) = rows.lock() {
                rows.extend(asked);
            }
            vec![false; asked.len()]
        });
        rows.into_inner().unwrap_or_default()
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
