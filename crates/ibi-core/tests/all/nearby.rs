//! The nearest point within a reach, and the spacing of a cloud: brute force in `f64`, and the laws that hold whatever
//! the data.

use std::collections::HashSet;

use ibi_core::kernels::nearby::{Nearby, mean_spacing};
use ibi_core::nalgebra::{Point3, Vector3};
use ibi_testkit::Rng;
use ibi_testkit::naive;
use ibi_testkit::strategies::{permutations, point, points, rigid_motions};
use proptest::prelude::*;

/// A coordinate relative to the middle is rounded by at most 2^-24 of itself. The query's rounding and the point's
/// both count, and twice where two distances are compared: 4 * 2^-24 = 2.4e-7 of the query's distance from the middle.
const ROUNDING: f64 = 2.5e-7;

/// The rest: differences, squares and sums of a distance, each rounded to `f32`; and the 1e-6 of leeway at the reach.
const RELATIVE: f64 = 2e-6;

/// Differences of the coordinates as they come, in `f64`.
const INPUT: f64 = 1e-15;

/// Median of each coordinate, as the kernel has it for up to 1000 points, and about so for more.
fn middle(cloud: &[Point3<f64>]) -> Point3<f64> {
    let median = |axis: usize| {
        let mut values: Vec<f64> = cloud.iter().map(|p| p[axis]).collect();
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    };
    Point3::new(median(0), median(1), median(2))
}

/// A bound of the box of cells: it leaves out a fiftieth at each end and adds a margin of a quarter.
fn spread(cloud: &[Point3<f64>], middle: &Point3<f64>) -> f64 {
    let mut far: Vec<f64> = cloud.iter().map(|p| (p - middle).norm()).collect();
    far.sort_by(f64::total_cmp);
    far.get((far.len() - far.len() / 50).saturating_sub(1)).map_or(0.0, |far| 3.0 * far)
}

/// Holds `nearest`, `nearest_each` and `within` against brute force, for each of the queries.
fn check_nearby(cloud: &[Point3<f64>], reach: f64, queries: &[Point3<f64>]) {
    let nearby = Nearby::new(cloud, reach);
    assert_eq!(nearby.reach(), reach);
    let middle = middle(cloud);
    let spread = spread(cloud, &middle);
    let mut rows = Vec::new();
    for query in queries {
        let off = (query - middle).norm();
        let doubt = ROUNDING * off + INPUT * query.coords.norm();
        // Which cell a point falls into is rounded too, relative to the box of the cells.
        let at_reach = doubt + ROUNDING * spread + RELATIVE * reach;
        let least = naive::nearest_dist_sq(cloud, query).sqrt();
        let row = nearby.nearest(query);
        rows.push(row);
        match row {
            Some(row) => {
                let distance = (cloud[row as usize] - query).norm();
                assert!(distance <= reach + at_reach, "{distance} is beyond {reach}");
                if least < reach - at_reach {
                    assert!(distance <= least + doubt + RELATIVE * least, "{distance}, not {least}");
                }
            }
            None => assert!(least >= reach - at_reach, "none within {reach}, but {least}"),
        }
        for distance in [0.0, 0.3 * reach, reach, 2.5 * reach] {
            check_within(&nearby, cloud, query, distance, doubt + RELATIVE * distance);
        }
    }
    assert_eq!(nearby.nearest_each(reach, queries), rows, "all at once as one by one");
    for distance in [0.0, 0.3 * reach, reach] {
        let nearest = nearby.nearest_each(distance, queries);
        let is_some: Vec<bool> = nearest.iter().map(Option::is_some).collect();
        assert_eq!(nearby.any_within_each(distance, queries), is_some);
    }
    let values: Vec<u32> = (1..=cloud.len() as u32).collect();
    for distance in [0.0, 0.3 * reach, reach, 2.5 * reach] {
        let sum = |query| nearby.within(query, distance).map(|row| values[row as usize]).sum::<u32>();
        let sums: Vec<u32> = queries.iter().map(sum).collect();
        assert_eq!(nearby.sums_within(distance, queries, &values), sums);
    }
}

fn check_within(nearby: &Nearby, cloud: &[Point3<f64>], query: &Point3<f64>, distance: f64, doubt: f64) {
    let rows: Vec<u32> = nearby.within(query, distance).collect();
    let set: HashSet<u32> = rows.iter().copied().collect();
    assert_eq!(rows.len(), set.len(), "a row twice");
    assert!(rows.iter().all(|&row| (cloud[row as usize] - query).norm() <= distance + doubt), "too far");
    let surely = naive::within(cloud, query, distance - doubt);
    assert!(surely.iter().all(|row| set.contains(row)), "{query} {distance}: missing");
}

/// Clouds of all kinds, within 10 of the origin: volumes, planes, lines, a point again and again, everything twice.
fn clouds(most: usize) -> impl Strategy<Value = Vec<Point3<f64>>> {
    (points(0..most), 0..6_u8).prop_map(|(mut cloud, kind)| {
        match kind {
            0 => cloud.iter_mut().for_each(|p| p.z = 0.25),
            1 => cloud.iter_mut().for_each(|p| (p.y, p.z) = (-1.5, 7.0)),
            2 => cloud.iter_mut().for_each(|p| *p = Point3::new(1.0, -2.0, 3.0)),
            3 => cloud.extend_from_within(..),
            // Most points in a small corner.
            4 => cloud.iter_mut().skip(3).for_each(|p| *p = Point3::new(9.0, 9.0, -9.0) + 0.01 * p.coords),
            _ => {}
        }
        cloud
    })
}

/// Reaches and radii of all magnitudes, from far below the spacing of a cloud to more than its width.
fn reaches() -> impl Strategy<Value = f64> {
    (-3.0..2.0).prop_map(|exponent| 10_f64.powf(exponent))
}

/// Anywhere, on points of the cloud, and about a reach away from them.
fn queries(cloud: &[Point3<f64>], places: &[Point3<f64>], reach: f64, seed: u64) -> Vec<Point3<f64>> {
    let mut rng = Rng::new(seed);
    let mut queries = places.to_vec();
    for p in cloud.iter().step_by(cloud.len().div_ceil(20).max(1)) {
        let aside = rng.normal_vector().normalize() * reach;
        queries.extend([*p, p + rng.in_box(reach), p + aside * 0.999, p + aside * 1.001]);
    }
    queries
}

proptest! {
    #[test]
    fn nearby_is_its_twin(
        cloud in clouds(120), places in points(1..20), reach in reaches(), seed: u64,
    ) {
        check_nearby(&cloud, reach, &queries(&cloud, &places, reach, seed));
    }

    // Neither georeferenced data nor odd units cost precision: the bounds are relative to the size of the cloud.
    #[test]
    fn nearby_keeps_its_precision_far_away_and_in_any_unit(
        cloud in clouds(60), places in points(1..10), reach in reaches(), seed: u64,
        offset in prop::array::uniform3(-1e6..1e6), unit in prop::sample::select(vec![1e-6, 1e-3, 1.0, 1e3, 1e6]),
    ) {
        let queries = queries(&cloud, &places, reach, seed);
        let moved = |points: &[Point3<f64>]| -> Vec<_> {
            points.iter().map(|p| (p + Vector3::from(offset)) * unit).collect()
        };
        check_nearby(&moved(&cloud), reach * unit, &moved(&queries));
    }

    // With 100 points and more the box of the cells leaves out the stray ones; with fewer the cells grow.
    #[test]
    fn stray_points_do_no_harm(
        cloud in clouds(150), places in points(1..10), reach in reaches(), seed: u64,
        stray in prop::array::uniform3(prop::sample::select(vec![-1e9, 0.5, 1e9])), at in any::<prop::sample::Index>(),
    ) {
        let mut queries = queries(&cloud, &places, reach, seed);
        let mut cloud = cloud;
        let stray = Point3::from(stray);
        cloud.insert(at.index(cloud.len() + 1), stray);
        queries.push(stray);
        check_nearby(&cloud, reach, &queries);
        prop_assert!(Nearby::new(&cloud, reach).nearest(&stray).is_some(), "the stray point is nearest to itself");
    }

    #[test]
    fn far_queries_find_nothing(cloud in clouds(60), reach in reaches(), way in point(), exponent in prop_oneof![3..15, 15..200]) {
        prop_assume!(way.coords.norm() > 0.1);
        let query = Point3::from(way.coords.normalize() * 10_f64.powi(exponent));
        let nearby = Nearby::new(&cloud, reach);
        prop_assert_eq!(nearby.nearest(&query), None);
        prop_assert_eq!(nearby.within(&query, reach).count(), 0);
        // All is near enough, as long as distances in reaches stay in the range of `f32`.
        if exponent < 15 {
            prop_assert_eq!(nearby.within(&query, 1.1e15).count(), cloud.len());
        }
    }
}

#[test]
fn few_points() {
    let (here, there) = (Point3::new(5.0, -3.0, 2.0), Point3::new(5.0, -3.0, 2.5));
    let empty = Nearby::new(&[], 1.0);
    assert_eq!((empty.nearest(&here), empty.nearest(&Point3::origin())), (None, None));
    assert_eq!(empty.within(&Point3::origin(), 1e9).count(), 0);
    assert_eq!(empty.nearest_each(1.0, &[here, here]), [None, None]);
    assert_eq!(empty.nearest_each(1.0, &[]), []);
    for reach in [1e-6, 0.499, 0.501, 1e9] {
        let one = Nearby::new(&[here], reach);
        assert_eq!(one.nearest(&here), Some(0));
        assert_eq!(one.nearest(&there), (reach > 0.5).then_some(0));
        assert_eq!(one.within(&here, 0.0).collect::<Vec<_>>(), [0]);
        let two = Nearby::new(&[here, there], reach);
        assert_eq!((two.nearest(&here), two.nearest(&there)), (Some(0), Some(1)));
    }
}

/// Points spread evenly over a sphere, at random.
fn sphere(n: usize, radius: f64, seed: u64) -> Vec<Point3<f64>> {
    let mut rng = Rng::new(seed);
    (0..n).map(|_| Point3::from(rng.normal_vector().normalize() * radius)).collect()
}

// Enough points that the grid has cells to get wrong, and that a sample stands for them in its box.
#[test]
fn nearby_is_its_twin_on_large_clouds() {
    let mut rng = Rng::new(5);
    let line: Vec<Point3<f64>> = (0..6000).map(|_| Point3::new(3.0, rng.between(-1e4, 1e4), -1.0)).collect();
    let lattice: Vec<Point3<f64>> = (0..18 * 18 * 18)
        .map(|i| Point3::new((i % 18).into(), (i / 18 % 18).into(), (i / 324).into()))
        .collect();
    let clusters: Vec<Point3<f64>> = (0..100)
        .flat_map(|_| {
            let centre = rng.in_box(1e3);
            (0..40).map(|_| Point3::from(centre + rng.normal_vector())).collect::<Vec<_>>()
        })
        .collect();
    for (cloud, reaches) in [
        (line, [0.7, 2.0, 300.0]),
        (lattice, [0.4, 1.0, 2.1]),
        (clusters, [0.05, 1.0, 40.0]),
        (sphere(5000, 10.0, 1), [0.05, 0.2, 3.0]),
    ] {
        for reach in reaches {
            let queries = queries(&cloud, &[Point3::origin()], reach, 9);
            check_nearby(&cloud, reach, &queries);
        }
    }
}

// ---------------------------------------------------------------------------------------------------- spacing

/// The mean is off by no more than one comparison of distances may be, every point lying within the widest.
fn spacing_doubt(cloud: &[Point3<f64>]) -> f64 {
    let middle = middle(cloud);
    let widest = cloud.iter().map(|p| (p - middle).norm()).fold(0.0, f64::max);
    let largest = cloud.iter().map(|p| p.coords.norm()).fold(0.0, f64::max);
    ROUNDING * widest + INPUT * largest
}

fn assert_spacing(cloud: &[Point3<f64>], expected: f64) {
    let (spacing, doubt) = (mean_spacing(cloud), spacing_doubt(cloud));
    assert!((spacing - expected).abs() <= doubt + 1e-6 * expected, "{spacing}, not {expected}");
}

proptest! {
    #[test]
    fn mean_spacing_is_its_twin(cloud in clouds(150)) {
        assert_spacing(&cloud, naive::mean_spacing(&cloud));
    }

    #[test]
    fn mean_spacing_follows_motion_order_and_unit(
        (cloud, order) in clouds(100).prop_flat_map(|cloud| {
            let n = cloud.len();
            (Just(cloud), permutations(n))
        }),
        motion in rigid_motions(1e6), exponent in -6..7,
    ) {
        let expected = mean_spacing(&cloud);
        let doubt = spacing_doubt(&cloud); // of the expected value itself
        let unit = 10_f64.powi(exponent);
        let permuted: Vec<_> = order.iter().map(|&i| cloud[i]).collect();
        let scaled: Vec<_> = cloud.iter().map(|p| p * unit).collect();
        let moved: Vec<_> = cloud.iter().map(|p| motion * p).collect();
        for (other, unit) in [(permuted, 1.0), (scaled, unit), (moved, 1.0)] {
            let spacing = mean_spacing(&other) / unit;
            let doubt = doubt + spacing_doubt(&other) / unit;
            prop_assert!((spacing - expected).abs() <= doubt + 1e-6 * expected, "{spacing}, not {expected}");
        }
    }

    // The nearest other point of a twin is 0 away, wherever it stands.
    #[test]
    fn coincident_points_are_0_apart(cloud in clouds(100), shift in 0..100_usize) {
        let mut twice = cloud.clone();
        twice.rotate_left(if cloud.is_empty() { 0 } else { shift % cloud.len() });
        twice.extend(cloud);
        prop_assert_eq!(mean_spacing(&twice), 0.0);
    }

    // Its own distance is all that a stray point adds. Precision is relative to each point's distance from the middle.
    #[test]
    fn a_stray_point_counts_only_itself(cloud in clouds(100), exponent in 4..10) {
        prop_assume!(cloud.len() > 2);
        let far = 10_f64.powi(exponent);
        let mut with = cloud.clone();
        with.push(Point3::new(far, -far, far));
        let n = cloud.len() as f64;
        let own = naive::nearest_dist_sq(&cloud, &with[cloud.len()]).sqrt();
        let others = mean_spacing(&with) * (n + 1.0) - own;
        let expected = naive::mean_spacing(&cloud) * n;
        // The first: the stray point's nearest; the others: of each point, and what the sum loses.
        let doubt = ROUNDING * 2.0 * far + n * spacing_doubt(&cloud) + 1e-6 * expected + 1e-14 * n * own;
        prop_assert!((others - expected).abs() <= doubt, "{others}, not {expected}");
    }
}

#[test]
fn spacing_of_few_or_identical_points() {
    let p = Point3::new(1e6, -2.0, 3e-6);
    assert_eq!(mean_spacing(&[]), 0.0);
    assert_eq!(mean_spacing(&[p]), 0.0);
    for n in [2, 3, 1000, 5000] {
        assert_eq!(mean_spacing(&vec![p; n]), 0.0);
    }
    for distance in [1e-9, 1.0, 1e12] {
        let two = [Point3::origin(), Point3::new(0.0, distance, 0.0)];
        assert_eq!(mean_spacing(&two), distance);
    }
    // The second of the three has its twin beside it; the far one is found though no cell around holds anything.
    let three = [Point3::origin(), Point3::origin(), Point3::new(300.0, 0.0, 0.0)];
    assert_eq!(mean_spacing(&three), 100.0);
}

// Up to 8192 points all are asked; fewer show it as well.
#[test]
fn mean_spacing_of_2048_points_is_exact() {
    let mut rng = Rng::new(8);
    let sparse: Vec<_> = (0..2048).map(|_| Point3::from(rng.in_box(1.0).map(|x| x.powi(5)))).collect();
    for cloud in [sphere(2048, 3.0, 2), sphere(2047, 1e6, 3), sparse] {
        assert_spacing(&cloud, naive::mean_spacing(&cloud));
    }
}

/// `naive::mean_spacing` for more points: of those sorted by x none is asked that is farther off along x alone than the
/// nearest so far.
fn swept_spacing(cloud: &[Point3<f64>]) -> f64 {
    let mut cloud = cloud.to_vec();
    cloud.sort_by(|a, b| a.x.total_cmp(&b.x));
    let nearest = |i: usize| {
        let side = |others: &mut dyn Iterator<Item = usize>, mut least: f64| {
            for j in others {
                if (cloud[j].x - cloud[i].x).abs() > least {
                    break;
                }
                least = least.min((cloud[j] - cloud[i]).norm());
            }
            least
        };
        side(&mut (0..i).rev(), side(&mut (i + 1..cloud.len()), f64::INFINITY))
    };
    (0..cloud.len()).map(nearest).sum::<f64>() / cloud.len() as f64
}

// Distances to the nearest neighbour on a surface spread by half of their mean (Rayleigh): the mean of 8192 is good to
// 0.6 %, so 3 % leave room for any seed that is not picked on purpose. In the uneven cloud they spread by 1.7 times
// their mean.
#[test]
fn mean_spacing_of_large_clouds_is_good_to_3_percent() {
    let small = sphere(700, 1.0, 4);
    assert!((swept_spacing(&small) / naive::mean_spacing(&small) - 1.0).abs() < 1e-12);

    let mut rng = Rng::new(6);
    let volume: Vec<_> = (0..20_000).map(|_| Point3::from(rng.in_box(1.0))).collect();
    // Dense here and sparse there: the sample must not favour either.
    let uneven = [sphere(15_000, 1.0, 5), sphere(5000, 10.0, 6)].concat();
    let mut with_stray = sphere(20_000, 1.0, 7);
    with_stray.insert(10_000, Point3::new(1e9, 1e9, 1e9));
    let stray = 3e18_f64.sqrt();
    for (cloud, stray, bound) in [
        (sphere(20_000, 1.0, 7), 0.0, 0.03),
        (volume, 0.0, 0.03),
        (uneven, 0.0, 0.1),
        (with_stray, stray, 0.03),
    ] {
        let n = cloud.len() as f64;
        // Whether the stray point is one of the sample, chance decides.
        let exact = swept_spacing(&cloud) - stray / n;
        let spacing = mean_spacing(&cloud);
        let without = if spacing > 2.0 * exact { spacing - stray / 8192.0 } else { spacing };
        assert!((without / exact - 1.0).abs() < bound, "{without}, not {exact}");
        assert_eq!(spacing.to_bits(), mean_spacing(&cloud).to_bits(), "always the same sample");
    }
}

#[test]
fn points_on_the_borders_and_in_the_middles_of_cells_are_found() {
    // A cell is a little wider than the reach. Of many widths some put points on a border or in a middle to the last bit.
    // A vector holds the points of the next cell too, unless there are enough in this one.
    const COPIES: u32 = 20;
    for step in 0..2000 {
        let half = 0.5 * (1.005 + 1e-9 * f64::from(step - 1000));
        for axis in 0..3 {
            let point = |k: u32| {
                let mut point = Point3::origin();
                point[axis] = half * f64::from(k);
                point
            };
            let cloud: Vec<_> = (0..12 * COPIES).map(|i| point(i / COPIES)).collect();
            let nearby = Nearby::new(&cloud, 1.0);
            for k in 0..12 {
                let near = nearby.nearest_each(0.5, &[point(k)])[0];
                assert_eq!(near.map(|row| row / COPIES), Some(k), "{half} {axis}");
            }
        }
    }
}
