//! Why a run ends.

/// Why a run ended, with the measured number and its limit.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize), serde(tag = "name", rename_all = "snake_case"))]
#[non_exhaustive]
pub enum StopReason {
    /// Fewer seeds than `t_s`: nothing consistent is left.
    FewSeeds {
        /// `N_s` of the last selection.
        value: u32,
        /// `t_s`.
        threshold: u32,
    },
    /// Too few correspondences alive for a pose.
    FewCorrespondences {
        /// How many were alive.
        value: u32,
        /// 3.
        threshold: u32,
    },
    /// `max_rejections` rounds in a row found no instance.
    MaxRejections {
        /// Rounds since the last instance.
        value: u32,
        /// The limit.
        threshold: u32,
    },
    /// `max_rounds` reached.
    MaxRounds {
        /// Rounds played.
        value: u32,
        /// The limit.
        threshold: u32,
    },
    /// `max_instances` reached.
    MaxInstances {
        /// Instances found.
        value: u32,
        /// The limit.
        threshold: u32,
    },
    /// `timeout_s` passed.
    Timeout {
        /// Seconds since the start.
        value: f64,
        /// The limit.
        threshold: f64,
    },
    /// The observer or the cancel token ended it.
    Cancelled,
    /// A round removed and barred nothing, so the next might repeat it for ever. The global game (`gtm`) with
    /// removal `inliers` can come to this, and with removal `dense` seeds that do not support each other
    /// (`nnsr`, `hough3d`).
    Stalled,
}

impl StopReason {
    /// Whether the run was ended from outside.
    pub(crate) fn is_from_outside(&self) -> bool {
        matches!(self, Self::Timeout { .. } | Self::Cancelled)
    }

    /// Whether the rounds ran dry, rather than being ended by a limit or from outside.
    pub(crate) fn is_dry(&self) -> bool {
        matches!(
            self,
            Self::FewSeeds { .. }
                | Self::FewCorrespondences { .. }
                | Self::MaxRejections { .. }
                | Self::Stalled
        )
    }
}

impl std::fmt::Display for StopReason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::FewSeeds { value, threshold } => write!(f, "few_seeds: {value} seeds, {threshold} needed"),
            Self::FewCorrespondences { value, threshold } => {
                write!(f, "few_correspondences: {value} alive, {threshold} needed")
            }
            Self::MaxRejections { value, threshold } => {
                write!(f, "max_rejections: {value} of {threshold} rounds without a new instance")
            }
            Self::MaxRounds { value, threshold } => write!(f, "max_rounds: {value} of {threshold} played"),
            Self::MaxInstances { value, threshold } => {
                write!(f, "max_instances: {value} of {threshold} found")
            }
            Self::Timeout { value, threshold } => {
                write!(f, "timeout: {value:.3} s passed, {threshold} s allowed")
            }
            Self::Cancelled => f.write_str("cancelled: by callback or token"),
            Self::Stalled => f.write_str("stalled: a round removed no correspondence"),
        }
    }
}
