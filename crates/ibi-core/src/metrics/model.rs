//! Errors between two poses of a model: ADD, ADD-S, MSSD.

use super::{MetricsError, diameter};
use crate::interrupt::{Interrupt, Phase};
use crate::kernels::discs::Discs;
use crate::kernels::neighbors::Neighbors;
use crate::kernels::par;
use crate::pace::Pace;
use crate::symmetries::{BOP_STEP, Symmetries, Turning};
use nalgebra::{Isometry3, Point3};
use std::borrow::Cow;
use std::collections::HashSet;
use std::sync::OnceLock;

/// The points of a model, with what its errors need: a tree and the diameter, each made on first use.
///
/// All errors are in the unit of the data. A dense model may be subsampled first: they are means and maxima
/// over the surface, at a cost per point.
///
/// # Examples
///
/// ```
/// use ibi_core::metrics::Model;
/// use ibi_core::{Interrupt, Symmetries};
/// use nalgebra::{Isometry3, Point3, Vector3};
/// use std::f64::consts::PI;
///
/// let stick = Model::new(vec![Point3::new(-1.0, 0.0, 0.0), Point3::new(1.0, 0.0, 0.0)])?;
/// let (truth, flipped) = (Isometry3::identity(), Isometry3::rotation(Vector3::z() * PI));
/// let never = Interrupt::never();
/// assert_eq!(stick.diameter(&never)?, 2.0);
/// // Each end is 2 from where it belongs, but on the other end: the stick looks right.
/// assert!((stick.add(&flipped, &truth) - 2.0).abs() < 1e-12);
/// assert!(stick.add_s(&flipped, &truth, &never)? < 1e-12);
/// assert!(stick.mssd(&flipped, &truth, &Symmetries::new(&[flipped], &[])?, &never)? < 1e-12);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Model {
    points: Vec<Point3<f64>>,
    tree: OnceLock<Neighbors>,
    discs: OnceLock<Discs>,
    diameter: OnceLock<f64>,
}

/// Points that one thread takes at a time.
const GRAIN: usize = 1024;

/// The work of a question for the nearest point, in the units of [`Pace`].
const QUERY: usize = 256;

/// A kd-tree is for no more points: building one cannot be interrupted.
const MOST_OF_TREE: usize = 1 << 17;

/// Points by which it is told whether a motion leaves the points near each other, and how many spacings near is.
const SAMPLE: usize = 64;
const NEAR: f64 = 4.0;

impl Model {
    /// A model of these points, in its own frame.
    ///
    /// # Errors
    ///
    /// [`MetricsError::EmptyModel`] without points, [`MetricsError::NonFinitePoint`] if a coordinate is not finite, or beyond
    /// 1e150.
    pub fn new(points: Vec<Point3<f64>>) -> Result<Self, MetricsError> {
        if points.is_empty() {
            return Err(MetricsError::EmptyModel);
        }
        if let Some(index) = points.iter().position(|p| !p.iter().all(|x| x.abs() <= 1e150)) {
            return Err(MetricsError::NonFinitePoint { index });
        }
        Ok(Self { points, tree: OnceLock::new(), discs: OnceLock::new(), diameter: OnceLock::new() })
    }

    /// The points, as given.
    #[must_use]
    pub fn points(&self) -> &[Point3<f64>] {
        &self.points
    }

    /// The largest distance between two points, see [`diameter()`].
    ///
    /// # Errors
    ///
    /// [`MetricsError::Interrupted`]; the same of all that takes an [`Interrupt`].
    pub fn diameter(&self, interrupt: &Interrupt) -> Result<f64, MetricsError> {
        if let Some(&known) = self.diameter.get() {
            return Ok(known);
        }
        // Not from within `get_or_init`: threads that wait for each other there could be those that have the work to do.
        let diameter = diameter(&self.points, interrupt)?;
        Ok(*self.diameter.get_or_init(|| diameter))
    }

    /// ADD: the mean distance between each model point under one pose and the same point under the other.
    ///
    /// Hinterstoisser et al., "Model based training, detection and pose estimation of texture-less 3D objects
    /// in heavily cluttered scenes", ACCV 2012.
    ///
    /// # Complexity
    ///
    /// O(n) in the number of points.
    #[must_use]
    pub fn add(&self, predicted: &Isometry3<f64>, truth: &Isometry3<f64>) -> f64 {
        // A common motion changes no distance, so one motion does in place of two.
        let difference = predicted.inverse() * truth;
        self.mean(|p| (difference * p - p).norm())
    }

    /// ADD-S: the mean distance between each model point under the truth and the model point *closest* to it
    /// under the prediction. Blind to symmetry, whether exact or only nearly so, with none declared.
    ///
    /// Not symmetric: exchanging the two poses changes the value, though little when it is small.
    ///
    /// From the same paper; named ADD-S by Xiang et al., "`PoseCNN`: A convolutional neural network for 6D object
    /// pose estimation in cluttered scenes", RSS 2018.
    ///
    /// # Complexity
    ///
    /// n questions to a tree of n points.
    ///
    /// # Errors
    ///
    /// [`MetricsError::Interrupted`].
    pub fn add_s(
        &self,
        predicted: &Isometry3<f64>,
        truth: &Isometry3<f64>,
        interrupt: &Interrupt,
    ) -> Result<f64, MetricsError> {
        if !interrupt.enter(Phase::Metrics) {
            return Err(MetricsError::Interrupted);
        }
        // Asked in the model's frame, where one tree serves every pose.
        let difference = predicted.inverse() * truth;
        let gaps_sq = if self.are_near(&difference) {
            self.gaps_sq_by_tree(&difference, interrupt)
        } else {
            self.gaps_sq_by_discs(&difference, interrupt)?
        };
        if interrupt.is_set() {
            return Err(MetricsError::Interrupted);
        }
        Ok(gaps_sq.into_iter().map(f64::sqrt).sum::<f64>() / self.points.len() as f64)
    }

    /// Over each place once: where many points coincide, a question would look at all of them.
    fn tree(&self) -> &Neighbors {
        self.tree.get_or_init(|| {
            let mut seen = HashSet::with_capacity(self.points.len());
            let is_new = |p: &&Point3<f64>| seen.insert(p.coords.map(f64::to_bits));
            Neighbors::new(&self.points.iter().filter(is_new).copied().collect::<Vec<_>>())
        })
    }

    /// Whether a kd-tree finds the nearest points of the moved ones faster: it does for those nearby, and is lost among points
    /// that are all about as far off. The answers are the same.
    fn are_near(&self, motion: &Isometry3<f64>) -> bool {
        if self.points.len() > MOST_OF_TREE {
            return false;
        }
        let tree = self.tree();
        let sample = || self.points.iter().step_by(self.points.len().div_ceil(SAMPLE));
        let gap = |p| tree.nearest(&(motion * p)).map_or(0.0, |(_, dist_sq)| dist_sq.sqrt());
        let first = self.points[0];
        let size = sample().map(|p| (p - first).norm()).fold(0.0, f64::max);
        let spacing = size / (self.points.len() as f64).sqrt();
        sample().map(gap).sum::<f64>() <= NEAR * spacing * sample().count() as f64
    }

    /// How far each point is from the nearest one once it is moved, squared; less than all if interrupted.
    fn gaps_sq_by_tree(&self, motion: &Isometry3<f64>, interrupt: &Interrupt) -> Vec<f64> {
        let tree = self.tree();
        let parts = par::chunks(self.points.len(), GRAIN, |run| {
            let mut pace = Pace::new(interrupt);
            let points = self.points[run].iter().take_while(|_| !pace.is_over(QUERY));
            points
                .map(|p| tree.nearest(&(motion * p)).map_or(0.0, |(_, dist_sq)| dist_sq))
                .collect::<Vec<_>>()
        });
        parts.concat()
    }

    /// The same by discs.
    fn gaps_sq_by_discs(
        &self,
        motion: &Isometry3<f64>,
        interrupt: &Interrupt,
    ) -> Result<Vec<f64>, MetricsError> {
        let discs = self.discs(interrupt)?;
        let parts = par::chunks(self.points.len(), GRAIN, |run| {
            let (mut near, mut pace) = (run.start, Pace::new(interrupt));
            let gap_sq = |(point, row): &(Point3<f64>, u32)| {
                let found = discs.nearest(&(motion * point), near);
                near = found.1;
                (*row, found.0)
            };
            let points = discs.points()[run].iter().take_while(|_| !pace.is_over(QUERY));
            points.map(gap_sq).collect::<Vec<_>>()
        });
        // By row, so that sums do not depend on the tree.
        let mut gaps_sq = vec![0.0; self.points.len()];
        parts.into_iter().flatten().for_each(|(row, gap_sq)| gaps_sq[row as usize] = gap_sq);
        Ok(gaps_sq)
    }

    /// Built on first use.
    fn discs(&self, interrupt: &Interrupt) -> Result<&Discs, MetricsError> {
        if let Some(discs) = self.discs.get() {
            return Ok(discs);
        }
        // Not from within `get_or_init`, as above.
        let discs = Discs::new(&self.points, interrupt).ok_or(MetricsError::Interrupted)?;
        Ok(self.discs.get_or_init(|| discs))
    }

    /// MSSD: the largest distance between a model point under the prediction and the same point under the
    /// truth, for the symmetry of the model under which this is least.
    ///
    /// Turns about an axis are tried in BOP's steps ([`BOP_STEP`]), from the nearest one on; a ball is turned to the
    /// truth.
    ///
    /// Hodan et al., "BOP challenge 2020 on 6D object localization", ECCV workshops 2020.
    ///
    /// # Complexity
    ///
    /// O(n s) at worst for n points and s symmetries; a symmetry is left at the first point worse than the
    /// best symmetry before it.
    ///
    /// # Errors
    ///
    /// [`MetricsError::Interrupted`].
    pub fn mssd(
        &self,
        predicted: &Isometry3<f64>,
        truth: &Isometry3<f64>,
        symmetries: &Symmetries,
        interrupt: &Interrupt,
    ) -> Result<f64, MetricsError> {
        if !interrupt.enter(Phase::Metrics) {
            return Err(MetricsError::Interrupted);
        }
        let (predicted, motions) = match symmetries.turning() {
            Turning::None => (*predicted, Cow::from(symmetries.discrete())),
            _ => (symmetries.nearest(predicted, truth), symmetries.listed(BOP_STEP).into()),
        };
        let difference = predicted.inverse() * truth;
        let (mut least_sq, mut pace) = (f64::INFINITY, Pace::new(interrupt));
        for symmetry in motions.iter() {
            let (max_sq, num_moved) = self.max_dist_sq(&(difference * symmetry), least_sq);
            if pace.is_over(num_moved) {
                return Err(MetricsError::Interrupted);
            }
            least_sq = least_sq.min(max_sq);
        }
        Ok(least_sq.sqrt())
    }

    /// The largest squared distance a point moves by, any number above `enough` once it is above that; and how many points
    /// were moved.
    fn max_dist_sq(&self, motion: &Isometry3<f64>, enough: f64) -> (f64, usize) {
        let mut max_sq = 0.0_f64;
        for (num, p) in (1..).zip(&self.points) {
            max_sq = max_sq.max((motion * p - p).norm_squared());
            if max_sq > enough {
                return (max_sq, num);
            }
        }
        (max_sq, self.points.len())
    }

    fn mean(&self, error: impl Fn(&Point3<f64>) -> f64) -> f64 {
        self.points.iter().map(error).sum::<f64>() / self.points.len() as f64
    }
}

#[cfg(test)]
mod tests {
    use super::super::strategies::{isometries, points};
    use super::*;
    use nalgebra::Vector3;
    use proptest::prelude::*;
    use std::f64::consts::{FRAC_PI_2, PI};

    fn models() -> impl Strategy<Value = Model> {
        points(1..30).prop_map(|points| Model::new(points).unwrap())
    }

    /// The naive twin of ADD-S, word for word after the formula.
    fn naive_add_s(model: &Model, predicted: &Isometry3<f64>, truth: &Isometry3<f64>) -> f64 {
        let closest = |p: &Point3<f64>| {
            model.points().iter().map(|q| (truth * p - predicted * q).norm()).fold(f64::INFINITY, f64::min)
        };
        model.points().iter().map(closest).sum::<f64>() / model.points().len() as f64
    }

    /// The naive twin of MSSD.
    fn naive_mssd(
        model: &Model,
        predicted: &Isometry3<f64>,
        truth: &Isometry3<f64>,
        symmetries: &[Isometry3<f64>],
    ) -> f64 {
        let identity = Isometry3::identity();
        let worst = |s: &Isometry3<f64>| {
            model.points().iter().map(|p| (predicted * p - truth * (s * p)).norm()).fold(0.0, f64::max)
        };
        symmetries.iter().chain([&identity]).map(worst).fold(f64::INFINITY, f64::min)
    }

    proptest! {
        #[test]
        fn agree_with_the_formulas(
            model in models(),
            a in isometries(),
            b in isometries(),
            symmetries in prop::collection::vec(isometries(), 0..4),
        ) {
            let add = model.points().iter().map(|p| (a * p - b * p).norm()).sum::<f64>();
            prop_assert!((model.add(&a, &b) - add / model.points().len() as f64).abs() < 1e-9);
            prop_assert!((model.add_s(&a, &b, &Interrupt::never()).unwrap() - naive_add_s(&model, &a, &b)).abs() < 1e-9);
            prop_assert!((model.mssd(&a, &b, &Symmetries::new(&symmetries, &[]).unwrap(), &Interrupt::never()).unwrap() - naive_mssd(&model, &a, &b, &symmetries)).abs() < 1e-9);
        }

        #[test]
        fn add_s_is_the_same_by_either_tree(model in models(), a in isometries(), far in any::<bool>()) {
            let small = Isometry3::from_parts((0.01 * a.translation.vector).into(), Isometry3::identity().rotation);
            let (motion, never) = (if far { a } else { small }, Interrupt::never());
            let by_discs = model.gaps_sq_by_discs(&motion, &never).unwrap();
            prop_assert_eq!(model.gaps_sq_by_tree(&motion, &never), by_discs);
        }

        #[test]
        fn in_their_order(model in models(), a in isometries(), b in isometries()) {
            // The closest point is no farther than the same point, a mean no larger than a maximum.
            let (add, add_s) = (model.add(&a, &b), model.add_s(&a, &b, &Interrupt::never()).unwrap());
            prop_assert!(add_s <= add + 1e-9);
            prop_assert!(add <= model.mssd(&a, &b, &Symmetries::none(), &Interrupt::never()).unwrap() + 1e-9);
        }

        // Moving the scene changes nothing; neither does giving the model in another frame.
        #[test]
        fn invariances(model in models(), a in isometries(), b in isometries(), motion in isometries()) {
            let moved = Model::new(model.points().iter().map(|p| motion.inverse() * p).collect()).unwrap();
            let none = Symmetries::none();
            let left = (motion * a, motion * b);
            let right = (a * motion, b * motion);
            prop_assert!((model.add(&left.0, &left.1) - model.add(&a, &b)).abs() < 1e-9);
            prop_assert!((model.add_s(&left.0, &left.1, &Interrupt::never()).unwrap() - model.add_s(&a, &b, &Interrupt::never()).unwrap()).abs() < 1e-9);
            prop_assert!((model.mssd(&left.0, &left.1, &none, &Interrupt::never()).unwrap() - model.mssd(&a, &b, &none, &Interrupt::never()).unwrap()).abs() < 1e-9);
            prop_assert!((moved.add(&right.0, &right.1) - model.add(&a, &b)).abs() < 1e-9);
            prop_assert!((moved.add_s(&right.0, &right.1, &Interrupt::never()).unwrap() - model.add_s(&a, &b, &Interrupt::never()).unwrap()).abs() < 1e-9);
            prop_assert!((moved.mssd(&right.0, &right.1, &none, &Interrupt::never()).unwrap() - model.mssd(&a, &b, &none, &Interrupt::never()).unwrap()).abs() < 1e-9);
        }
    }

    /// The corners of a square of side 2 about the origin, in the plane z = 0.
    fn square() -> Model {
        let corners = [[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, -1.0, 0.0]];
        Model::new(corners.map(Point3::from).to_vec()).unwrap()
    }

    #[test]
    fn a_square_turned_by_a_quarter_looks_the_same() {
        let turn = Isometry3::rotation(Vector3::z() * FRAC_PI_2);
        let quarter = Symmetries::new(&[turn], &[]).unwrap();
        let truth = Isometry3::translation(3.0, 1.0, 0.0);
        let predicted = truth * turn;
        // Each corner moves along one side, 2; the corner it lands on is where the model has one.
        assert!((square().add(&predicted, &truth) - 2.0).abs() < 1e-12);
        assert!(square().add_s(&predicted, &truth, &Interrupt::never()).unwrap() < 1e-12);
        assert!(
            (square().mssd(&predicted, &truth, &Symmetries::none(), &Interrupt::never()).unwrap() - 2.0)
                .abs()
                < 1e-12
        );
        assert!(square().mssd(&predicted, &truth, &quarter, &Interrupt::never()).unwrap() < 1e-12);
    }

    #[test]
    fn half_a_turn_counts_to_the_far_corner_unless_a_quarter_is_allowed() {
        // Half a turn moves a corner along the diagonal, 2 sqrt(2); a quarter turn of it back leaves a side, 2.
        let predicted = Isometry3::rotation(Vector3::z() * PI);
        let quarter = Symmetries::new(&[Isometry3::rotation(Vector3::z() * FRAC_PI_2)], &[]).unwrap();
        let truth = Isometry3::identity();
        assert!(
            (square().mssd(&predicted, &truth, &Symmetries::none(), &Interrupt::never()).unwrap()
                - 8.0_f64.sqrt())
            .abs()
                < 1e-12
        );
        assert!(
            (square().mssd(&predicted, &truth, &quarter, &Interrupt::never()).unwrap() - 2.0).abs() < 1e-12
        );
    }

    #[test]
    fn add_s_asks_from_the_truth_to_the_prediction() {
        // Points at x = 0, 1 and 10; the prediction is 9 too far right, so its points are at 9, 10 and 19.
        // From the truth: 0 -> 9 is 9, 1 -> 9 is 8, 10 -> 10 is 0: 17 / 3.
        // The other way round: 9 -> 10 is 1, 10 -> 10 is 0, 19 -> 10 is 9: 10 / 3.
        let model = Model::new([0.0, 1.0, 10.0].map(|x| Point3::new(x, 0.0, 0.0)).to_vec()).unwrap();
        let (truth, predicted) = (Isometry3::identity(), Isometry3::translation(9.0, 0.0, 0.0));
        assert!((model.add_s(&predicted, &truth, &Interrupt::never()).unwrap() - 17.0 / 3.0).abs() < 1e-12);
        assert!((model.add_s(&truth, &predicted, &Interrupt::never()).unwrap() - 10.0 / 3.0).abs() < 1e-12);
    }

    #[test]
    fn a_model_needs_finite_points() {
        assert_eq!(Model::new(vec![]).unwrap_err(), MetricsError::EmptyModel);
        let points = vec![Point3::origin(), Point3::new(0.0, f64::NAN, 0.0)];
        assert_eq!(Model::new(points).unwrap_err(), MetricsError::NonFinitePoint { index: 1 });
    }
}
