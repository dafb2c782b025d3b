//! Parameters: plain data, all defaulted, checked once when a [`crate::Registrar`] takes them.
//!
//! Every length ends in `_pr` and is a multiple of the resolution `pr`, the mean of the two clouds' mean
//! nearest-neighbour distances, so that nothing depends on the unit of the data.

use crate::error::Error;
use crate::kernels::compatibility::Payoff;
#[cfg(feature = "serde")]
use crate::ranges::none_or;
use crate::ranges::{at_least_1, at_least_3, check, positive};
use crate::scene::Tolerances;
use crate::stages::ce::{Ce, Voting};
use crate::stages::hv::{Evidence, Hv, Overlap};
use crate::stages::scs::{Gtm, LocalGtm, Scs};
use crate::stages::te::{Gsac, Irls, Te};

/// How a registration runs.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct Params {
    /// Key of all random streams. The same seed gives the same bits, for any number of threads.
    pub seed: u64,
    /// pr in data units; `None` estimates it from the clouds. > 0.
    #[cfg_attr(feature = "serde", serde(deserialize_with = "none_or"))]
    pub resolution: Option<f64>,
    /// `delta_r` of Eq. 5: how fast payoff and votes fall with the rigidity, in pr. > 0.
    pub delta_r_pr: f64,
    /// `t_he` of Eq. 8: largest residual of an inlier, in pr. > 0.
    pub t_he_pr: f64,
    /// `d_op`: largest distance of overlapping points, in pr. > 0.
    pub d_op_pr: f64,
    /// Least cosine between the normals of an inlier's two points, and of overlapping points; with a viewpoint,
    /// points that cannot be seen from it count in no overlap. `None` leaves normals out of both. -1 to 1.
    #[cfg_attr(feature = "serde", serde(deserialize_with = "none_or"))]
    pub min_normal_cos: Option<f64>,
    /// Whether the normals are oriented: outwards on the source, towards the camera on the target. If not, they are
    /// compared up to sign, and the viewpoint cannot tell which source points can be seen.
    pub oriented_normals: bool,
    /// `t_s`: a run ends when fewer seeds than this are found. At least 3.
    pub t_s: u32,
    /// Seed correspondence selection.
    pub scs: Scs,
    /// Correspondence enhancement.
    pub ce: Ce,
    /// Transformation estimation.
    pub te: Te,
    /// Hypothesis validation.
    pub hv: Hv,
    /// How a hypothesis is polished on the clouds before it is validated.
    pub refine: Refine,
    /// A contest lasts this many rounds: at its end the hypotheses that passed validation become instances, best
    /// value first. 1: each at once, as it is found. At least 1.
    pub n_contest: u32,
    /// Whether at the end all accepted poses compete for the target at once, and those that fail validation on what
    /// is nearest to them are dropped.
    pub joint_check: bool,
    /// Which correspondences a round removes.
    pub removal: Removal,
    /// A run ends after this many rounds in which nothing new passed validation; `None`: no limit.
    #[cfg_attr(feature = "serde", serde(deserialize_with = "none_or"))]
    pub max_rejections: Option<u32>,
    /// A run ends after this many rounds; `None`: no limit.
    #[cfg_attr(feature = "serde", serde(deserialize_with = "none_or"))]
    pub max_rounds: Option<u32>,
    /// A run ends with this many instances; `None`: no limit.
    #[cfg_attr(feature = "serde", serde(deserialize_with = "none_or"))]
    pub max_instances: Option<u32>,
    /// A run ends after this many seconds and keeps what it has; `None`: no limit. What was found by then is still checked and
    /// ranked as far as a bounded amount of work goes, see [`crate::Registrar::finish`]. >= 0.
    #[cfg_attr(feature = "serde", serde(deserialize_with = "none_or"))]
    pub timeout_s: Option<f64>,
}

/// How a hypothesis is polished on the clouds before it is validated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
#[non_exhaustive]
pub enum Refine {
    /// Not at all.
    #[default]
    None,
    /// Iterative closest points within 2 `d_op`: point-to-plane where `min_normal_cos` lets normals count,
    /// else point-to-point. First on few points, for a glance, then on more; of an accepted hypothesis the better one
    /// of before and after stays. At least `t_s` alive correspondences must still agree.
    Icp,
    /// The same; and in a scene seen from one side a hypothesis that is about to become an instance is turned about by
    /// right angles of the source's principal axes, polished, and the best of the 24 poses taken, as parts that look
    /// alike from several sides are often found the wrong way round.
    IcpTurns,
}

/// Which correspondences a round removes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
#[non_exhaustive]
pub enum Removal {
    /// The dense correspondences `C_d` of the round, accepted or not.
    // PAPER: the text removes C_d after a rejection too; its pseudocode does not, and can loop for ever.
    #[default]
    Dense,
    /// When an instance is accepted, the alive correspondences within 2 `t_he` of it and those whose target point
    /// it explains. The seeds of a round may not lead again, nor may the inliers of a hypothesis that passed.
    Inliers,
}

impl Default for Params {
    /// Not of the paper: all correspondences play, one neighbourhood at a time, in a second-order compatibility graph;
    /// hypotheses are polished on the clouds, judged by how unlikely their support is by chance, and compete for the
    /// scene before and after they are accepted. For scenes seen whole or nearly so; normals help where both clouds
    /// have them.
    fn default() -> Self {
        Self {
            delta_r_pr: 1.0,
            t_he_pr: 1.5,
            d_op_pr: 1.5,
            min_normal_cos: Some(0.3),
            t_s: 4,
            scs: LocalGtm::default().into(),
            te: Irls::default().into(),
            hv: Evidence::default().into(),
            refine: Refine::Icp,
            n_contest: 60,
            joint_check: true,
            removal: Removal::Inliers,
            max_rejections: Some(60),
            ..Self::paper_synthetic()
        }
    }
}

impl Params {
    /// The paper's setting for its synthetic data set.
    #[must_use]
    pub fn paper_synthetic() -> Self {
        Self {
            seed: 0,
            resolution: None,
            delta_r_pr: 10.0,
            t_he_pr: 10.0,
            d_op_pr: 1.5,
            min_normal_cos: None,
            oriented_normals: false,
            t_s: 5,
            scs: Gtm { n_downsample: 1024, n_gtm: 20, payoff: Payoff::Gaussian }.into(),
            ce: Voting { n_vot: 300 }.into(),
            te: Gsac { n_gsac: 100, ..Gsac::default() }.into(),
            hv: Overlap { t_overlap: 0.85, exclusive: false }.into(),
            refine: Refine::None,
            n_contest: 1,
            joint_check: false,
            removal: Removal::Dense,
            max_rejections: None,
            max_rounds: None,
            max_instances: None,
            timeout_s: None,
        }
    }

    /// The paper's setting for its real data set.
    #[must_use]
    pub fn paper_real() -> Self {
        Self {
            t_he_pr: 1.0,
            d_op_pr: 3.0,
            te: Gsac { n_gsac: 20, ..Gsac::default() }.into(),
            hv: Overlap { t_overlap: 0.7, exclusive: false }.into(),
            ..Self::paper_synthetic()
        }
    }

    /// For a scene seen by one depth camera. Give the normals of both clouds, oriented, and the viewpoint.
    ///
    /// Not of the paper: all correspondences play, one neighbourhood at a time; a hypothesis is polished on the
    /// clouds before it is judged, by the source points that the camera can see and the scene points that no other
    /// instance explains; hypotheses compete before one becomes an instance, and that one is tried the other ways round.
    #[must_use]
    pub fn single_view() -> Self {
        Self {
            delta_r_pr: 2.0,
            t_he_pr: 2.0,
            d_op_pr: 1.5,
            min_normal_cos: Some(0.5),
            oriented_normals: true,
            t_s: 4,
            scs: LocalGtm {
                tau_pr: 2.0,
                min_length_pr: 2.0,
                normal_tolerance: 0.3,
                max_degree: 256,
                first_look: None,
                ..LocalGtm::default()
            }
            .into(),
            te: Irls::default().into(),
            refine: Refine::IcpTurns,
            hv: Evidence { t_sure: 1.0, ..Evidence::default() }.into(),
            n_contest: 60,
            removal: Removal::Inliers,
            max_rejections: Some(600),
            ..Self::paper_synthetic()
        }
    }

    /// For a scene that was seen from many places: by a camera that went about, or from all sides. Give the normals of both clouds,
    /// oriented, and where the camera stood, if that is known.
    ///
    /// [`Self::single_view`], with more patience: large scenes hold much that looks like a part.
    #[must_use]
    pub fn many_views() -> Self {
        Self { max_rejections: Some(4000), ..Self::single_view() }
    }

    /// When points agree.
    pub(crate) fn tolerances(&self) -> Tolerances {
        let Self { t_he_pr, d_op_pr, min_normal_cos, oriented_normals, .. } = *self;
        Tolerances { t_he_pr, d_op_pr, min_normal_cos, oriented_normals }
    }

    /// Checks every parameter against its range.
    ///
    /// # Errors
    /// [`Error::Param`] for the first one out of range.
    pub fn validate(&self) -> Result<(), Error> {
        positive("resolution", self.resolution.unwrap_or(1.0))?;
        positive("delta_r_pr", self.delta_r_pr)?;
        positive("t_he_pr", self.t_he_pr)?;
        positive("d_op_pr", self.d_op_pr)?;
        let cos = self.min_normal_cos.unwrap_or(0.0);
        check("min_normal_cos", cos, (-1.0..=1.0).contains(&cos), "between -1 and 1")?;
        at_least_3("t_s", self.t_s)?;
        at_least_1("n_contest", self.n_contest)?;
        let timeout_s = self.timeout_s.unwrap_or(0.0);
        check("timeout_s", timeout_s, (0.0..=1e9).contains(&timeout_s), "between 0 and 1e9 seconds")?;
        self.scs.check()?;
        self.ce.check()?;
        self.te.check()?;
        self.hv.check()
    }
}
