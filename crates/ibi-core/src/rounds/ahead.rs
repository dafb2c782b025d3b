//! Looking ahead: where a second thread is idle it selects the seeds of the next round while this one is played.
//!
//! They are selected as they will be if this round comes to nothing: most do, and else they are selected again. A wrong guess
//! costs time only.

use super::problem::Problem;
use super::stages::Stages;
use crate::kernels::par;
use crate::params::Removal;
use crate::registration::Timings;
use crate::stages::Ranked;

/// The seeds of the next round, selected beforehand; dropped once anything has changed but what a round that comes to nothing
/// changes.
#[derive(Debug, Default)]
pub(crate) struct Ahead(Option<(Ranked, Timings)>);

impl Ahead {
    pub(super) fn take(&mut self) -> Option<(Ranked, Timings)> {
        self.0.take()
    }

    pub(super) fn put(&mut self, selected: Option<(Ranked, Timings)>) {
        self.0 = selected;
    }

    pub(super) fn forget(&mut self) {
        self.0 = None;
    }
}

impl Stages<'_> {
    /// Whether the seeds of a round may be selected before the one before it is concluded. Not with stages of the user's,
    /// which may count their rounds; nor if a round removes correspondences whatever comes of it; nor at a first look, which
    /// the number of neighbourhoods that come to nothing brings to its end.
    pub(super) fn may_look_ahead(&self, problem: &Problem<'_>) -> bool {
        let Self { params, has_own, shortcuts, .. } = *self;
        let is_settled = params.removal == Removal::Inliers && !problem.is_sampled();
        shortcuts.ahead && par::is_parallel() && !has_own && is_settled
    }
}
