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
    /// That of as many points as there are in a detail of the part, together: the noise times their spacing, both in 24ths of the part's
    /// diagonal.
    pub blur: f64,
    /// How sharp the scan's edges are, see [`super::noise::sharpness_of_edges`].
    pub edges: Option<f64>,
    /// Whether the scan was fused from what several cameras measured, or one that went about.
    pub is_fused: bool,
    /// How close its points lie on the thinned clouds, see [`super::Support::closeness`].
    pub closeness: f64,
    /// -log10 of the chance that as many correspondences would agree, see [`super::Support::evidence`].
    pub evidence: f64,
    /// What other poses of the part that are sure by themselves add to the log odds, see [`Self::among`].
    pub company: f64,
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

/// The same where a scan is coarse, but sharp at its edges, to searches in piles. There less is seen of a pose, and it is believed by itself
/// only if much speaks for it; see [`company`].
const COARSE: [f64; TERMS] = [-4.69, -30.1, -5.14, -29.2, 1.09, 1.32, 2.45, 0.0, 0.03, 0.26];

/// Up to the first a scan is sharp, and from the second on it is coarse; in between weights are mixed in proportion. Bins of the tuning
/// half have 0.09 at most, coarse real scans and piles 0.13 and more.
const BLUR: [f64; 2] = [0.1, 0.13];

/// Of a coarse scan whose edges are soft a close look tells nothing: up to the first they are, from the second on they are sharp, in between
/// in proportion. Coarse real scans of the tuning half, of parts that are not quite the model's shape, in which a close look mistrusts every
/// pose, have 0.22 and 0.37; ray-cast ones as coarse have 0.45 to 0.75.
const EDGES: [f64; 2] = [0.38, 0.44];

fn share(value: f64, [from, to]: [f64; 2]) -> f64 {
    ((value - from) / (to - from)).clamp(0.0, 1.0)
}

/// Whether a close look at a scan of one camera tells nothing.
pub(super) fn is_blurred(blur: f64, edges: Option<f64>) -> bool {
    blur >= BLUR[1] && edges.is_none_or(|edges| edges <= EDGES[0])
}

/// What company is worth in a coarse scan, and in a sharp one, and for how many at most. Of searches in piles of the tuning half it brings
/// back the right poses that were lost to `COARSE`, which asks for more than weights that know of no company, and few wrong ones. In sharp
/// scans each pose is seen well enough to be decided on by itself; that it is found among others makes it more sure, by as much as bins of
/// the tuning half have shown.
const COMPANY: f64 = 2.5;
const COMPANY_OF_FOUND: f64 = 1.0;
const MOST_COMPANY: f64 = 3.0;

/// What it is that others of the same part are found, each so sure by itself, from 0 to 1: the more, the likelier is another. Nothing
/// where there is none: a part may lie alone.
#[must_use]
pub fn company(certainties: impl Iterator<Item = f64>) -> f64 {
    certainties.fold(0.0, |sum, sure| sum + sure).min(MOST_COMPANY).ln_1p()
}

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
        self.log_odds_alone() + self.company
    }

    /// How sure the pose is by itself, from 0 at even odds to 1.
    #[must_use]
    pub fn certainty(&self) -> f64 {
        (2.0 * probability(self.log_odds_alone()) - 1.0).max(0.0)
    }

    /// The same pose in such [`company`], as it is decided on: that counts as far as the scan is coarse and has sharp edges.
    #[must_use]
    pub fn among(self, company: f64) -> Self {
        let [_, coarse, _] = self.kinds();
        self.with_company(COMPANY * coarse * company)
    }

    /// The same of a pose that was found: in sharp scans, too, it is more sure.
    #[must_use]
    pub fn found_among(self, company: f64) -> Self {
        let [sharp, coarse, _] = self.kinds();
        self.with_company((COMPANY * coarse + COMPANY_OF_FOUND * sharp) * company)
    }

    /// In scans that were fused from many views each pose is seen well enough.
    fn with_company(self, company: f64) -> Self {
        Self { company: if self.is_fused { 0.0 } else { company }, ..self }
    }

    /// How much a scan of one camera is sharp, coarse with sharp edges, and blurred, in sum 1.
    fn kinds(&self) -> [f64; 3] {
        let blur = share(self.blur, BLUR);
        let edges = self.edges.map_or(0.0, |edges| share(edges, EDGES));
        [1.0 - blur, blur * edges, blur * (1.0 - edges)]
    }

    fn log_odds_alone(&self) -> f64 {
        let [contradicted, runs_on, beyond] = self.objections();
        let closeness = self.closeness.clamp(CLOSENESS[0], CLOSENESS[1]);
        let [_, second, third] = self.losses.map(held);
        let terms: [f64; TERMS] = [
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
        let weighed =
            |terms: &[f64], weights: &[f64]| -> f64 { terms.iter().zip(weights).map(|(a, b)| a * b).sum() };
        if self.is_fused {
            return weighed(&terms, &FUSED);
        }
        let of_clouds = weighed(&[1.0, self.evidence.ln_1p(), self.closeness], &ONE_SIDED);
        let [sharp, coarse, blurred] = self.kinds();
        sharp * weighed(&terms, &SHARP) + coarse * weighed(&terms, &COARSE) + blurred * of_clouds
    }

    /// The probability that the pose is right.
    #[must_use]
    pub fn score(&self) -> f64 {
        probability(self.log_odds())
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

fn probability(log_odds: f64) -> f64 {
    1.0 / (1.0 + (-log_odds).exp())
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
