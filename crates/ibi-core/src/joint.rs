//! The joint check: all accepted poses compete for the target at once.
//!
//! In the rounds the earlier pose claims first. At the end every scene point goes to the pose nearest to it, so
//! that a wrong early pose cannot live on what belongs to a right later one.

use crate::correspondence::Alive;
use crate::params::Params;
use crate::scene::Claims;
use crate::stages::{Context, Validate};
use crate::state::{Found, Problem};

/// Which target points each pose explains, and which pose owns each of them.
pub(crate) struct Shares {
    /// For each pose the (target row, distance) it explains.
    explained: Vec<Vec<(u32, f64)>>,
    /// For each target row the pose nearest to it.
    owners: Vec<u32>,
}

impl Shares {
    pub(crate) fn new(problem: &Problem<'_>, found: &[Found]) -> Self {
        let explained = found.iter().map(|found| found.explained.clone()).collect();
        let mut shares = Self { explained, owners: vec![Claims::NOBODY; problem.scene.target.points.len()] };
        shares.share_out();
        shares
    }

    fn share_out(&mut self) {
        let mut nearest = vec![f64::INFINITY; self.owners.len()];
        self.owners.fill(Claims::NOBODY);
        for (pose, explained) in (0_u32..).zip(&self.explained) {
            for &(row, distance) in explained {
                if distance < nearest[row as usize] {
                    nearest[row as usize] = distance;
                    self.owners[row as usize] = pose;
                }
            }
        }
    }

    /// Whether no other pose is nearer to anything that this one explains.
    fn owns_all(&self, pose: usize) -> bool {
        self.explained[pose].iter().all(|&(row, _)| self.owners[row as usize] == pose as u32)
    }

    /// Takes a pose out; what it owned goes to the next nearest.
    fn remove(&mut self, pose: usize) {
        self.explained.remove(pose);
        self.share_out();
    }

    /// What `ask` answers where only that is free which no other pose owns.
    pub(crate) fn alone<T>(
        &self,
        problem: &Problem<'_>,
        params: &Params,
        pose: usize,
        ask: impl FnOnce(&Context<'_>) -> T,
    ) -> T {
        let claims = Claims::of_others(&self.owners, pose as u32);
        let is_free = |id: u32| !claims.contains(problem.pairs.target_rows[id as usize]);
        let alive = Alive::filtered(&problem.pairs, is_free);
        ask(&problem.context_of(params, 0, &alive, claims))
    }
}

/// Drops the poses that fail validation on what is their own, the worst first.
pub(crate) fn joint_check(problem: &Problem<'_>, params: &Params, hv: &dyn Validate, found: &mut Vec<Found>) {
    let mut shares = Shares::new(problem, found);
    while found.len() > 1 {
        let margin = |(at, found): (usize, &Found)| {
            if shares.owns_all(at) {
                return None; // as when it was accepted
            }
            let verdict = shares.alone(problem, params, at, |own| hv.validate(own, &found.hypothesis));
            (!verdict.accepted()).then_some((at, verdict.value - verdict.threshold))
        };
        let failed = found.iter().enumerate().filter_map(margin);
        let Some((worst, _)) = failed.min_by(|(_, a), (_, b)| a.total_cmp(b)) else { return };
        found.remove(worst);
        shares.remove(worst);
    }
}
