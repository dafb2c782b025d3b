//! The diameter of a cloud.

use nalgebra::{Point3, Vector3};

use super::discs::{Disc, LEAF};
use super::par;
use crate::interrupt::{Interrupt, Phase};
use crate::pace::Pace;

/// Slack of the pruning bound: rounding may make a sum of two radii fall short of the true bound by a few
/// units in the last place, and a pair must not be lost to that.
const ROUNDING: f64 = 1.0 + 1e-12;

/// Of no more points that are far enough out, all pairs are compared.
const FEW: usize = 4096;

/// Where there are more, a pair that is longer by no more than this part is not looked for: else clouds of
/// which very many pairs are the longest but for rounding would take for ever.
const NEGLIGIBLE: f64 = 1e-14;

/// Points that one thread takes at a time.
const GRAIN: usize = 1 << 14;

/// The largest distance between two points of a cloud, exactly; 0 for fewer than two points.
///
/// The unit in which ADD-S and MSSD thresholds are given. The answer is the one a comparison of all pairs
/// would give; only pairs that cannot be the farthest are left out. About the centroid c,
/// |p - q| <= |p - c| + |q - c|, so a point falls once the sum with the largest radius is below a distance
/// already seen. Sweeps to the farthest point give such a distance, most often the diameter itself, before
/// the search begins. If more than 4096 points are left, as on a sphere, they are sorted into flat discs
/// and pairs of discs are compared: then the answer may fall short by 1e-14 of it, a few units in the last place.
///
/// `None` if interrupted.
///
/// # Complexity
///
/// O(n) for the elongated shapes most parts are; about O(n log n) for points all about equally far
/// from the centroid.
#[must_use]
pub(crate) fn diameter(points: &[Point3<f64>], interrupt: &Interrupt) -> Option<f64> {
    if !interrupt.enter(Phase::Diameter) {
        return None;
    }
    if points.len() < 2 {
        return Some(0.0);
    }
    let sums = par::chunks(points.len(), GRAIN, |run| {
        points[run].iter().fold(Vector3::zeros(), |sum, p| sum + p.coords)
    });
    let centroid = Point3::from(sums.iter().sum::<Vector3<f64>>() / points.len() as f64);
    let (first, largest) = farthest(points, &centroid, interrupt)?;
    let (one_end, _) = farthest(points, &first, interrupt)?;
    let (_, longest) = farthest(points, &one_end, interrupt)?;

    let kept = par::chunks(points.len(), GRAIN, |run| {
        let is_far = |(radius, _): &(f64, _)| (radius + largest) * ROUNDING >= longest;
        let with_radius = points[run].iter().map(|p| ((p - centroid).norm(), *p));
        with_radius.filter(is_far).collect::<Vec<_>>()
    });
    let far = kept.concat();
    if far.len() <= FEW {
        compare_all(far, longest, interrupt)
    } else {
        compare_discs(far.into_iter().map(|(_, p)| p).collect(), longest, interrupt)
    }
}

/// The point farthest from `from`, the first of equals, and its distance.
fn farthest(points: &[Point3<f64>], from: &Point3<f64>, interrupt: &Interrupt) -> Option<(Point3<f64>, f64)> {
    let farther =
        |best: (Point3<f64>, f64), next: (Point3<f64>, f64)| if next.1 > best.1 { next } else { best };
    let parts = par::chunks(points.len(), GRAIN, |run| {
        if interrupt.is_set() {
            return (*from, 0.0);
        }
        points[run].iter().map(|p| (*p, (p - from).norm())).fold((*from, 0.0), farther)
    });
    if interrupt.is_set() {
        return None;
    }
    Some(parts.into_iter().fold((*from, 0.0), farther))
}

/// The longest pair, at least `longest`, of points with their distances from one place: the tail of pairs of a point
/// falls once the sum is below the longest so far.
fn compare_all(
    mut by_radius: Vec<(f64, Point3<f64>)>,
    mut longest: f64,
    interrupt: &Interrupt,
) -> Option<f64> {
    by_radius.sort_unstable_by(|a, b| b.0.total_cmp(&a.0));
    let mut pace = Pace::new(interrupt);
    for (rank, (radius, p)) in by_radius.iter().enumerate() {
        let rest = &by_radius[rank + 1..];
        // Every pair still to come is shorter than the best of this point's.
        if rest.first().is_none_or(|(next, _)| (radius + next) * ROUNDING < longest) {
            break;
        }
        if pace.is_over(rest.len()) {
            return None;
        }
        for (other_radius, q) in rest {
            if (radius + other_radius) * ROUNDING < longest {
                break;
            }
            longest = longest.max((p - q).norm());
        }
    }
    Some(longest)
}

/// Pairs of discs that are handed to threads, about.
const TASKS: usize = 256;

/// How many points sweeps begin from.
const SWEEPS: usize = 16;

/// The same by a tree of discs, as a smooth surface has them: then what bounds a pair of discs is too large by the square of
/// their size only, and of each disc few others are in question.
fn compare_discs(mut points: Vec<Point3<f64>>, mut longest: f64, interrupt: &Interrupt) -> Option<f64> {
    for k in 0..SWEEPS {
        let (end, _) = farthest(&points, &points[k * points.len() / SWEEPS], interrupt)?;
        longest = longest.max(farthest(&points, &end, interrupt)?.1);
    }
    let root = Disc::new(&mut points, 0, &|p: &Point3<f64>| *p, interrupt)?;
    // The tasks are the same on any number of threads, and none knows of what another one has found.
    let mut tasks = vec![(&root, &root)];
    loop {
        let halved: Vec<_> = tasks.iter().flat_map(|&(a, b)| a.halves(b)).collect();
        let is_done = halved.len() == tasks.len();
        tasks = halved.into_iter().filter(|(a, b)| may_hold(a.bound(b), longest)).collect();
        if is_done || tasks.len() >= TASKS || interrupt.is_set() {
            break;
        }
    }
    let found = par::map(tasks.len(), 1, |i| {
        let (mut longest, mut pace) = (longest, Pace::new(interrupt));
        descend(&points, tasks[i], &mut longest, &mut pace);
        longest
    });
    if interrupt.is_set() { None } else { Some(found.into_iter().fold(longest, f64::max)) }
}

/// Whether a pair may be longer, by more than [`NEGLIGIBLE`], if it is no longer than the bound.
fn may_hold(bound: f64, longest: f64) -> bool {
    bound > longest * (1.0 + NEGLIGIBLE)
}

/// Raises `longest` to that of the pairs of points of two discs; false if interrupted.
fn descend(points: &[Point3<f64>], (a, b): (&Disc, &Disc), longest: &mut f64, pace: &mut Pace<'_>) -> bool {
    if pace.is_over(LEAF * LEAF) {
        return false;
    }
    if a.parts.is_none() && b.parts.is_none() {
        // All at one place: one stands for all.
        let run = |disc: &Disc| {
            if disc.reach > 0.0 { disc.run.clone() } else { disc.run.start..disc.run.start + 1 }
        };
        for p in &points[run(a)] {
            for q in &points[run(b)] {
                *longest = longest.max((p - q).norm());
            }
        }
        return true;
    }
    let mut pairs: Vec<_> = a.halves(b).into_iter().map(|(a, b)| (a.bound(b), (a, b))).collect();
    pairs.sort_by(|a, b| b.0.total_cmp(&a.0));
    pairs.into_iter().all(|(bound, pair)| !may_hold(bound, *longest) || descend(points, pair, longest, pace))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::float_cmp, reason = "tests may panic, and compare what is exact")]
mod tests {
    use super::*;
    use crate::metrics::strategies::{isometries, points};
    use proptest::prelude::*;

    fn exact(points: &[Point3<f64>]) -> f64 {
        diameter(points, &Interrupt::never()).unwrap()
    }

    /// The naive twin.
    fn brute_force(points: &[Point3<f64>]) -> f64 {
        points.iter().flat_map(|p| points.iter().map(move |q| (p - q).norm())).fold(0.0, f64::max)
    }

    proptest! {
        #[test]
        fn equals_the_comparison_of_all_pairs(cloud in points(0..60)) {
            prop_assert_eq!(exact(&cloud), brute_force(&cloud));
        }

        // On a sphere nothing can be pruned by radius: the worst case must be right too.
        #[test]
        fn equals_the_comparison_of_all_pairs_on_a_sphere(cloud in points(2..60), offset in -1e3..1e3) {
            let sphere: Vec<_> = cloud
                .iter()
                .filter_map(|p| p.coords.try_normalize(1e-3))
                .map(|n| Point3::from(n.add_scalar(offset)))
                .collect();
            prop_assert_eq!(exact(&sphere), brute_force(&sphere));
        }

        #[test]
        fn does_not_change_under_a_rigid_motion(cloud in points(0..60), motion in isometries()) {
            let moved: Vec<_> = cloud.iter().map(|p| motion * p).collect();
            prop_assert!((exact(&moved) - exact(&cloud)).abs() < 1e-9);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(12))]

        // Too many for a comparison of all pairs, all nearly equally far out, some of them at one place: ellipsoids,
        // clouds within, circles, two plates far apart. The naive twin is asked for a sample of the points, and of all
        // as many as are far from them.
        #[test]
        fn of_many_points_by_discs_as_by_all_pairs(
            half_axes in prop::array::uniform3(0.9..1.0_f64), flat in 0..4_u32, seed in 0..1000_u64, apart in 0.0..1e7_f64,
        ) {
            let mut rng = crate::kernels::rng::Rng::new(seed, 0, 0);
            let mut point = || -> Point3<f64> {
                let x: Vector3<f64> = Vector3::from([0; 3].map(|_: u32| 2.0 * rng.unit() - 1.0));
                let on_ball = x.try_normalize(1e-3).unwrap_or_else(Vector3::x);
                let p: Vector3<f64> = on_ball.component_mul(&Vector3::from(half_axes));
                Point3::from(match flat {
                    0 => p,
                    1 => p * (1.0 - 0.001 * rng.unit()),
                    2 => Vector3::new(p.x, p.y, 0.0).normalize(),
                    _ => Vector3::new(x.x, x.y, if x.z > 0.0 { apart } else { 0.0 }),
                })
            };
            let mut cloud: Vec<_> = (0..FEW + 500).map(|_| point()).collect();
            cloud.extend_from_within(..FEW / 2);
            let by_discs = compare_discs(cloud.clone(), 0.0, &Interrupt::never()).unwrap();
            let naive = brute_force(&cloud);
            prop_assert!(by_discs <= naive && by_discs >= naive * (1.0 - 2.0 * NEGLIGIBLE), "{by_discs} {naive}");
            prop_assert!((exact(&cloud) - naive).abs() <= naive * 2.0 * NEGLIGIBLE);
        }
    }

    #[test]
    fn of_a_grid_with_many_equal_pairs() {
        // 3 x 4 x 5 unit cells: the four space diagonals are all sqrt(9 + 16 + 25) = sqrt(50).
        let grid: Vec<_> = (0..=3)
            .flat_map(|x| (0..=4).flat_map(move |y| (0..=5).map(move |z| Point3::new(x, y, z).cast::<f64>())))
            .collect();
        assert_eq!(exact(&grid), 50.0_f64.sqrt());
    }

    #[test]
    fn of_almost_nothing() {
        assert_eq!(exact(&[]), 0.0);
        assert_eq!(exact(&[Point3::new(1.0, 2.0, 3.0)]), 0.0);
        assert_eq!(exact(&[Point3::new(1.0, 2.0, 3.0); 5]), 0.0);
    }
}
