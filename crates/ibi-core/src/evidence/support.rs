//! How much speaks for a pose: what agrees with it, held against what would agree by chance in this very scene.
//!
//! A-contrario reasoning (Desolneux, Moisan & Morel 2000): a pose is meaningful if its support would hardly ever
//! come about among correspondences whose source points know nothing of their target points.

/// What was counted of one pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Support {
    /// n: alive correspondences whose target point the moved source explains.
    pub num_explained: u32,
    /// k: those of them whose source point comes to lie within `t_he` of the target point.
    pub num_agreeing: u32,
    /// p: the chance that one of the n agrees if its source point was drawn from those of all correspondences.
    pub chance: f64,
    /// Mean over the visible source points of max(0, 1 - d / reach), d being the distance to the nearest target
    /// point that is free: 1 for a perfect fit. Quan's overlap with a slope in the place of a step.
    pub fit: f64,
    /// Sum of the same over the number of all source points: how much of the source the scene explains.
    pub explained: f64,
    /// The same for the target: mean over the alive correspondences whose target point lies within reach of the moved
    /// source of 1 - d / reach, d being that distance.
    pub back_fit: f64,
    /// The fit that chance gives a pose somewhere on the target.
    pub chance_fit: f64,
    /// The fit that the noise of the scene lets a right pose have.
    pub best_fit: f64,
    /// Whether only the source points that a camera can see were looked at.
    pub one_sided: bool,
}

impl Default for Support {
    /// Nothing speaks for the pose, in a scene without noise.
    fn default() -> Self {
        Self {
            num_explained: 0,
            num_agreeing: 0,
            chance: 0.0,
            fit: 0.0,
            explained: 0.0,
            back_fit: 0.0,
            chance_fit: 0.0,
            best_fit: 1.0,
            one_sided: false,
        }
    }
}

impl Support {
    /// At most -log10 P[Bin(n, p) >= k]: n KL(k/n || p) / ln 10 (Hoeffding 1963). 0 where no more agree than chance
    /// explains.
    #[must_use]
    pub fn evidence(&self) -> f64 {
        let n = f64::from(self.num_explained);
        let share = f64::from(self.num_agreeing) / n.max(1.0);
        let p = self.chance.clamp(1e-9, 1.0 - 1e-9);
        if share <= p {
            return 0.0;
        }
        let part = |a: f64, b: f64| if a > 0.0 { a * (a / b).ln() } else { 0.0 };
        n * (part(share, p) + part(1.0 - share, 1.0 - p)) / std::f64::consts::LN_10
    }

    /// How much closer the source fits than chance would have it: 0 as by chance, 1 as close as the scene lets a pose be.
    ///
    /// In a scene seen from one side that is how closely its own points fit each other on average, which an instance whose
    /// surface is smoother than the rest may surpass: then it is more than 1. 0 also where the points of the scene fit each
    /// other no better than by chance: nothing can be told.
    #[must_use]
    pub fn closeness(&self) -> f64 {
        let range = self.best_fit - self.chance_fit;
        if range > 0.0 { (self.fit - self.chance_fit) / range } else { 0.0 }
    }

    /// Logarithm of the odds that the pose is right.
    #[must_use]
    pub fn log_odds(&self) -> f64 {
        let [constant, evidence, closeness, back_fit] = if self.one_sided { ONE_SIDED } else { WHOLE };
        constant
            + evidence * self.evidence().ln_1p()
            + closeness * self.closeness()
            + back_fit * self.back_fit
    }

    /// The probability that the pose is right.
    #[must_use]
    pub fn score(&self) -> f64 {
        1.0 / (1.0 + (-self.log_odds()).exp())
    }
}

/// Weights of 1, ln(1 + evidence), closeness and `back_fit` in the log odds: a logistic regression over the poses, right
/// and wrong, that runs with a threshold near 0 return on the tuning half of the benchmark layouts, in some of which a
/// part of each object is cut off by a plane. `benchmarks/calibration.py --fit` fits them anew.
const WHOLE: [f64; 4] = [-26.8, 1.27, 17.45, 18.75];

/// The same for scenes seen from one side. `benchmarks/one_view.py` prints what share of the poses of each score is right,
/// in ray-cast piles, real scans, and scans of another part; these weights are more cautious than its `--fit`, for those
/// who look for a part that may not be there. Correspondences hardly count: a part found the wrong way round has as many
/// as the right pose.
pub(super) const ONE_SIDED: [f64; 4] = [-5.1, 0.05, 9.7, 0.0];
