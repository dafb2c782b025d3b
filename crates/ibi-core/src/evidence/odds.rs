//! What all measures of a pose come to: the odds that it is right.

use super::contour::{Contour, Overrun};
use super::seen::Tally;
use super::support::ONE_SIDED;

/// What was measured of a pose.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct Measures {
    /// How its points are seen.
    pub tally: Tally,
    /// What is beyond the ends of its faces.
    pub contour: Contour,
    /// What is around it.
    pub overrun: Overrun,
    /// What it loses when it is moved a little; see [`super::slip::losses`].
    pub losses: [f64; 3],
    /// Standard deviation of the scan across its surfaces, voxels.
    pub noise: f64,
    /// That of as many points as there are in a voxel, together: the noise times their spacing, both in voxels.
    pub blur: f64,
    /// Whether the scan was fused from what several cameras measured, or one that went about.
    pub is_fused: bool,
    /// How close its points lie on the thinned clouds, see [`super::Support::closeness`].
    pub closeness: f64,
    /// -log10 of the chance that as many correspondences would agree, see [`super::Support::evidence`].
    pub evidence: f64,
}

/// So many points, or ends, are worth as much as what is believed without any.
const FEW_POINTS: f64 = 20.0;
const FEW_ENDS: f64 = 15.0;

/// Of the ends of a pose of which nothing is known, the share that would run on.
const USUALLY_RUNS_ON: f64 = 0.5;

/// More says no more: of what is contradicted to what is known, and of what is beyond a part to what is on it.
const MOST_CONTRADICTED: f64 = 0.1;
const MOST_BEYOND: f64 = 0.2;

/// Closeness beyond these says no more.
const CLOSENESS: [f64; 2] = [-0.5, 1.1];

/// How many weights there are: of 1, the share contradicted, how far faces run on, the share beyond, the second and third loss,
/// closeness, the share supported, and the logarithms of the number of ends and of the evidence. The first loss told nothing beside them.
const TERMS: usize = 10;

/// Weights where a scan is sharp: a logistic regression over the poses, right and wrong, of searches in the tuning half of
/// `benchmarks/verdict.py`, found and rejected, none of which may be of the wrong sign: `benchmarks/verdict_fit.py` fits them anew, to
/// the poses of today.
const SHARP: [f64; TERMS] = [-2.77, -26.9, -4.31, -35.9, 2.01, 0.0, 0.66, 2.24, 0.0, 0.0];

/// The same where a scan was fused from many views, to searches in rooms and for parts that are not in them: there a part is seen from
/// several sides, so that a right pose is held by all of its faces, and has more ends that are seen past than a wrong one.
const FUSED: [f64; TERMS] = [-14.7, -9.6, -4.6, -45.3, 4.1, 2.0, 0.0, 3.3, 1.46, 0.47];

/// Up to the first a scan is sharp, and from the second on a close look tells no more than the clouds; in between it counts in
/// proportion. Bins of the tuning half have 0.116 at most. Coarse real scans of parts that are not quite the model's shape have 0.158 and
/// more: there a close look mistrusts every pose. (In ray-cast scans as coarse it is as sure as in sharp ones.)
const BLUR: [f64; 2] = [0.12, BLURRED];
pub(super) const BLURRED: f64 = 0.15;

/// Of a loss the root: the step from none to a little tells most.
fn held(loss: f64) -> f64 {
    loss.clamp(0.0, 1.0).sqrt()
}

impl Measures {
    /// Share contradicted, how far faces run on, share beyond: 0 where nothing is known, so that the unknown speaks neither for a pose
    /// nor against it.
    #[must_use]
    pub fn objections(&self) -> [f64; 3] {
        let Self { tally, contour, overrun, .. } = self;
        let [contradicted, known] = [tally.contradicted, tally.known()].map(f64::from);
        let [runs_on, ends] = [contour.runs_on, contour.ends].map(f64::from);
        let [beyond, on] = [overrun.beyond, overrun.on].map(f64::from);
        [
            (contradicted / (known + FEW_POINTS)).min(MOST_CONTRADICTED),
            (runs_on - USUALLY_RUNS_ON * (runs_on + ends)) / (runs_on + ends + FEW_ENDS),
            (beyond / (on + FEW_POINTS)).min(MOST_BEYOND),
        ]
    }

    /// Share of the points that face an eye which are supported.
    fn share_supported(&self) -> f64 {
        let [supported, facing] =
            [self.tally.supported, self.tally.known() + self.tally.hidden].map(f64::from);
        supported / (facing + FEW_POINTS)
    }

    fn weights(&self) -> &'static [f64; TERMS] {
        if self.is_fused { &FUSED } else { &SHARP }
    }

    /// Logarithm of the odds that the pose is right.
    #[must_use]
    pub fn log_odds(&self) -> f64 {
        let [contradicted, runs_on, beyond] = self.objections();
        let closeness = self.closeness.clamp(CLOSENESS[0], CLOSENESS[1]);
        let [_, second, third] = self.losses.map(held);
        let sharp: [f64; TERMS] = [
            1.0,
            contradicted,
            runs_on,
            beyond,
            second,
            third,
            closeness,
            self.share_supported(),
            f64::from(self.contour.ends).ln_1p(),
            self.evidence.ln_1p(),
        ];
        let blurred = [1.0, self.evidence.ln_1p(), self.closeness];
        // Of a fused scan the clouds alone tell nothing.
        let blur = if self.is_fused { 0.0 } else { self.blur };
        let blur = ((blur - BLUR[0]) / (BLUR[1] - BLUR[0])).clamp(0.0, 1.0);
        let weighed =
            |terms: &[f64], weights: &[f64]| -> f64 { terms.iter().zip(weights).map(|(a, b)| a * b).sum() };
        (1.0 - blur) * weighed(&sharp, self.weights()) + blur * weighed(&blurred, &ONE_SIDED)
    }

    /// The probability that the pose is right.
    #[must_use]
    pub fn score(&self) -> f64 {
        1.0 / (1.0 + (-self.log_odds()).exp())
    }

    /// What speaks most against the pose.
    #[must_use]
    pub fn objection(&self) -> Objection {
        let weights = self.weights();
        let [contradicted, runs_on, beyond] = self.objections();
        let [_, second, third] = self.losses.map(held);
        let all = [
            (weights[1] * contradicted, Objection::Contradicted),
            (weights[2] * runs_on, Objection::RunsOn),
            (weights[3] * beyond, Objection::Overrun),
            (weights[4] * (second - USUALLY_HELD) + weights[5] * (third - USUALLY_HELD), Objection::Slips),
            (weights[6] * (self.closeness.clamp(CLOSENESS[0], CLOSENESS[1]) - 1.0), Objection::Loose),
        ];
        all.into_iter().min_by(|(a, _), (b, _)| a.total_cmp(b)).map_or(Objection::Loose, |(_, worst)| worst)
    }
}

/// How well a right pose is held along a motion, about.
const USUALLY_HELD: f64 = 0.5;

/// What speaks most against a pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize), serde(rename_all = "snake_case"))]
#[non_exhaustive]
pub enum Objection {
    /// The eye looked through it.
    Contradicted,
    /// The scene goes on where its faces should end.
    RunsOn,
    /// Points around it carry its surface on.
    Overrun,
    /// Moved a little, it fits as well.
    Slips,
    /// Its surface lies off what was measured.
    Loose,
    /// Better poses of other models explain too much of what it explains: see [`crate::detection::Models`].
    Outdone,
}
