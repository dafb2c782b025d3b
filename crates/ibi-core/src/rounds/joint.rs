//! The joint check: all accepted poses compete for the target at once.
//!
//! In the rounds the earlier pose claims first. At the end every scene point goes to the pose nearest to it, so
//! that a wrong early pose cannot live on what belongs to a right later one.

use std::sync::Mutex;

use nalgebra::Point3;

use super::instances::{Instance, Instances};
use super::problem::Problem;
use super::stages::Stages;
use super::state::State;
use crate::detail::Detail;
use crate::evidence::{Ledger, Support, are_near};
use crate::grace::Grace;
use crate::interrupt::Phase;
use crate::kernels::par;
use crate::scene::Alive;
use crate::stages::{Context, Validate, Verdict};

/// What `ask` answers of an instance where only that is free which no other one is nearer to. `context` is that of all
/// correspondences and all instances.
fn alone<T>(
    context: &Context<'_>,
    ledger: &Ledger<'_>,
    instance: usize,
    found: &Instance,
    ask: impl FnOnce(&Context<'_>) -> T,
) -> T {
    let claims = context.claims.against(instance, ledger);
    let near = claims.near(found.pose());
    if near.is_empty() {
        return ask(&Context { claims, ..*context });
    }
    let reach_pr = 2.0 * context.scene.tolerances.d_op_pr;
    let around = context.witnesses().around(reach_pr, found.pose());
    let rows: Vec<u32> = around.iter().map(|&id| context.pairs.target_rows[id as usize]).collect();
    let claimed = around.iter().zip(near.contain(&rows)).filter(|&(_, is_claimed)| is_claimed);
    let claimed: Vec<u32> = claimed.map(|(&id, _)| id).collect();
    let mut alive = Alive::all(context.pairs);
    alive.remove(&claimed);
    ask(&Context { claims, alive: &alive, ..*context })
}

impl State<'_> {
    /// What speaks for each instance. With `joint_check` the poses that fail validation on what is their own are dropped, the
    /// worst first.
    ///
    /// Those for which there is no time are dropped. Once the run is ended and the time for the joint check is over, all that
    /// fail go at once, and so do those that have not been measured yet; the others keep what spoke for them among all: less
    /// than there would be without those.
    pub(crate) fn supports(&mut self, stages: &Stages<'_>, grace: &mut Grace<'_>) -> Vec<Support> {
        let Self { problem, instances, .. } = self;
        problem.interrupt.begin(Phase::JointCheck);
        let everything = Alive::all(&problem.pairs);
        let context = Context { alive: &everything, ..problem.context(stages.params, 0, instances.poses()) };
        if !stages.params.joint_check {
            let cost = problem.cost_of_look();
            let support = |at: usize| context.support(Detail::Look, instances[at].pose(), false);
            let supports = grace.map(instances.len(), |_| cost, support);
            return instances.keep(supports);
        }
        let (hv, cost) = (stages.hv, problem.cost_of(stages.hv));
        let measured = Check { problem, hv, context, instances, cost }.run(grace);
        instances.keep(measured).into_iter().map(|own| own.support).collect()
    }
}

/// Where no pose is near more others than this each is asked for each, which is quicker than a ledger of so few.
const FEW_NEAR: usize = 16;

struct Check<'a> {
    problem: &'a Problem<'a>,
    hv: &'a dyn Validate,
    context: Context<'a>,
    instances: &'a Instances,
    /// Of measuring one.
    cost: usize,
}

impl Check<'_> {
    /// What is left, and what it is worth.
    fn run(&self, grace: &mut Grace<'_>) -> Vec<Option<Own>> {
        let Self { problem, instances, .. } = *self;
        let found = instances.poses();
        let scene = &problem.scene;
        let centres: Vec<Point3<f64>> = found.iter().map(|pose| pose * scene.source.centre).collect();
        let are_near = |a: usize, b: usize| a != b && are_near(scene, &found[a], &centres[b]);
        let mut num_near =
            par::map(found.len(), 256, |a| (0..found.len()).filter(|&b| are_near(b, a)).count());
        let mut ledger = Ledger::new(scene, found.to_vec());
        let disputed: Vec<usize> = (0..found.len()).filter(|&at| num_near[at] > 0).collect();
        let are_many = num_near.iter().any(|&num| num > FEW_NEAR);
        if are_many {
            let rows = grace.map(disputed.len(), |_| self.cost, |i| self.rows(&instances[disputed[i]]));
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
                    let found = &instances[at];
                    alone(&self.context, &ledger, at, found, |own| Own::new(own, self.hv, found))
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
                is_stale[at] |= asks_all && problem.are_near(&found[at], &found[worst]);
            }
            for at in 0..found.len() {
                is_stale[at] &= measured[at].is_some();
            }
        }
    }

    /// The rows of the target that will be asked for an instance.
    fn rows(&self, found: &Instance) -> Vec<u32> {
        let Self { problem, context, .. } = self;
        let reach_pr = 2.0 * problem.scene.tolerances.d_op_pr;
        let around = context.witnesses().around(reach_pr, found.pose());
        let rows: Vec<u32> = around.iter().map(|&id| problem.pairs.target_rows[id as usize]).collect();
        let rows = Mutex::new(rows);
        let _ = problem.scene.fit(Detail::Look, found.pose(), |asked| {
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
    fn new(context: &Context<'_>, hv: &dyn Validate, found: &Instance) -> Self {
        let support = context.support(Detail::Look, found.pose(), true);
        let is_disputed = !context.claims.near(found.pose()).is_empty();
        let verdict = || hv.verdict_of(&support).unwrap_or_else(|| hv.validate(context, &found.hypothesis));
        Self { support, verdict: is_disputed.then(verdict) }
    }
}
