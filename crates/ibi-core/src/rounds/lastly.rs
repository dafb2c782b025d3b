//! The last polish: accepted poses on all that was measured, and how well they are known.

use nalgebra::Isometry3;

use super::state::State;
use crate::evidence::{Correlation, Fine, Fitted, Pairs};
use crate::grace::Grace;
use crate::interrupt::Phase;

impl State<'_> {
    /// Polishes each instance once more, where there is more to look at than the clouds. Those for which there is no time stay as
    /// they are.
    ///
    /// What the points of all of them lie off tells how much of it neighbours share: on one alone that is not known well.
    pub(crate) fn polish_lastly(&mut self, grace: &mut Grace<'_>) {
        let Self { problem, instances, .. } = self;
        let Some(closeup) = problem.closeup() else { return };
        if instances.is_empty() || closeup.is_fused() {
            return;
        }
        problem.interrupt.begin(Phase::Polish);
        let scene = &problem.scene;
        let Some(fine) = Fine::new(closeup, scene) else { return };
        let poses = instances.poses();
        let fit = |at: usize| {
            instances[at].proof?;
            let is_near = |&other: &usize| other != at && problem.are_near(&poses[at], &poses[other]);
            let others: Vec<Isometry3<f64>> =
                (0..poses.len()).filter(is_near).map(|other| poses[other]).collect();
            fine.fit(closeup, scene, &poses[at], &others)
        };
        let fitted: Vec<Option<Fitted>> =
            grace.map(poses.len(), |_| fine.cost(), fit).into_iter().map(Option::flatten).collect();
        let pairs = fitted.iter().flatten().fold(Pairs::default(), |sum, fitted| sum.and(&fitted.pairs));
        let correlation = Correlation::of(&pairs);
        for (at, fitted) in fitted.into_iter().enumerate() {
            if let Some(fitted) = fitted {
                instances.polished(at, fitted.target_from_source, fitted.known(&correlation));
            }
        }
    }
}
