//! Fast point feature histograms.

use nalgebra::{Point3, Vector3};

use super::FeatureError;
use super::around::{Around, Neighborhood, Others};
use super::door::{check_len, check_points, unit_normals};
use super::pairs::{Pairs, SECTORS};
use crate::interrupt::{Interrupt, Phase};

/// Numbers of a descriptor: three histograms.
pub const FPFH_DIM: usize = 3 * SECTORS;

/// Numbers of a histogram in memory: whole vectors.
const WIDTH: usize = 40;

/// The histograms of one point and its neighbours, each of the three with a sum of 100, or 0 without neighbours.
type Spfh = [f32; WIDTH];

/// No larger weight, so that sums stay finite: of a neighbour 1e-15 radii away.
const MAX_WEIGHT: f64 = 1e30;

/// The descriptor of each point (Rusu et al. 2009), or of the rows `keypoints` alone, in that order.
///
/// As Open3D's `compute_fpfh_feature` has it: eleven bins for each of the three angles, neighbours weighted by the
/// inverse of their squared distance, each mean of histograms scaled to 100 and the point's own histogram added. A
/// point without neighbours gets zeros, and so the sum of a histogram is 200 or 0; it is 100 for a point whose neighbours are
/// all at its own place, and so have no weight. Normals are brought to length 1, which Open3D takes for granted.
///
/// # Errors
/// If a coordinate is not finite, if there is not one normal of some length for each point, if the radius is not above
/// 0, if fewer than 2 neighbours may count, if a key point is not a row of the cloud.
///
/// # Complexity
/// O(n k) time for k points around each; 250 bytes a point beside the result.
pub fn fpfh(
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    neighborhood: Neighborhood,
    keypoints: Option<&[usize]>,
    interrupt: &Interrupt,
) -> Result<Vec<[f32; FPFH_DIM]>, FeatureError> {
    check_points("points", points)?;
    let normals = unit_normals("normals", normals, points.len())?;
    neighborhood.check(2, "at least 2, the point itself among them")?;
    check_keypoints(keypoints.unwrap_or_default(), points.len())?;
    if !interrupt.enter(Phase::Fpfh) {
        return Err(FeatureError::Interrupted);
    }
    let around = Around::new(points, neighborhood, interrupt)?;
    let n = points.len();
    let order = around.order();
    let normals: Vec<[f32; 3]> = order.iter().map(|&row| normals[row as usize].cast().into()).collect();

    let all: Vec<u32> = (0..n as u32).collect();
    let (wanted, needed) = match keypoints {
        None => (all.clone(), all),
        Some(rows) => {
            let wanted = wanted_places(&around, rows);
            let needed = with_neighbors(&around, &wanted, interrupt)?;
            (wanted, needed)
        }
    };
    let histograms = around.map(
        &needed,
        interrupt,
        #[inline(always)]
        |place, others, pairs: &mut Pairs| spfh(&around, &normals, place, others, pairs),
    )?;
    // By place, zeros where nobody asks.
    let histograms = if needed.len() == n { histograms } else { spread(&needed, histograms, n) };
    let sorted =
        around.map(&wanted, interrupt, |place, others, (): &mut ()| mean(&histograms, place, others))?;

    let mut at_place = vec![0; n];
    wanted.iter().zip(0..).for_each(|(&place, i)| at_place[place as usize] = i);
    let mut at_row = vec![0; n];
    order.iter().zip(at_place).for_each(|(&row, i)| at_row[row as usize] = i);
    Ok(match keypoints {
        None => at_row.into_iter().map(|i: usize| sorted[i]).collect(),
        Some(rows) => rows.iter().map(|&row| sorted[at_row[row]]).collect(),
    })
}

fn check_keypoints(rows: &[usize], len: usize) -> Result<(), FeatureError> {
    check_len("keypoints", rows.len())?;
    let bad = rows.iter().position(|&row| row >= len);
    bad.map_or(Ok(()), |at| {
        Err(FeatureError::RowOutOfRange {
            argument: "keypoints",
            at,
            row: i64::try_from(rows[at]).unwrap_or(i64::MAX),
            of: "points",
            len,
        })
    })
}

/// Each place of these rows once, ascending.
fn wanted_places(around: &Around, rows: &[usize]) -> Vec<u32> {
    let mut is_wanted = vec![false; around.order().len()];
    for &row in rows {
        is_wanted[row] = true;
    }
    (0..).zip(around.order()).filter(|&(_, &row)| is_wanted[row as usize]).map(|(place, _)| place).collect()
}

/// These places and their neighbours, each once and ascending.
fn with_neighbors(around: &Around, wanted: &[u32], interrupt: &Interrupt) -> Result<Vec<u32>, FeatureError> {
    let lists = around.map(wanted, interrupt, |_, others, (): &mut ()| others.places().to_vec())?;
    let mut is_needed = vec![false; around.order().len()];
    wanted.iter().chain(lists.iter().flatten()).for_each(|&place| is_needed[place as usize] = true);
    Ok((0..).zip(is_needed).filter(|&(_, is_needed)| is_needed).map(|(place, _)| place).collect())
}

fn spread(places: &[u32], histograms: Vec<Spfh>, n: usize) -> Vec<Spfh> {
    let mut all = vec![[0.0; WIDTH]; n];
    places.iter().zip(histograms).for_each(|(&place, histogram)| all[place as usize] = histogram);
    all
}

#[inline(always)]
#[allow(clippy::inline_always)] // into a loop for the vector units
fn spfh(around: &Around, normals: &[[f32; 3]], place: usize, others: &Others, pairs: &mut Pairs) -> Spfh {
    pairs.clear(others.places().len());
    let (q, unit) = (around.point(place), around.inv_radius());
    pairs.fill(others.places().iter().map(|&other| {
        let p = around.point(other as usize);
        // The difference before rounding, so that it has all digits wherever the cloud lies.
        let d = [(p[0] - q[0]) * unit, (p[1] - q[1]) * unit, (p[2] - q[2]) * unit];
        (d.map(|x| x as f32), normals[other as usize])
    }));
    let counts = pairs.count(normals[place]);
    let mut histogram = [0.0; WIDTH];
    let share = 100.0 / others.places().len().max(1) as f32;
    for (value, count) in histogram.iter_mut().zip(counts.as_flattened()) {
        *value = *count as f32 * share;
    }
    histogram
}

#[inline(always)]
#[allow(clippy::inline_always)]
fn mean(histograms: &[Spfh], place: usize, others: &Others) -> [f32; FPFH_DIM] {
    let (mut sum, mut weights) = ([0.0; WIDTH], 0.0);
    for (&other, &dist_sq) in others.places().iter().zip(others.dist_sq()) {
        // A point at the same place has no weight.
        let weight = if dist_sq > 0.0 { (others.radius_sq() / dist_sq).min(MAX_WEIGHT) as f32 } else { 0.0 };
        let histogram = &histograms[other as usize];
        for k in 0..WIDTH {
            sum[k] += weight * histogram[k];
        }
        weights += weight;
    }
    let scale = if weights > 0.0 { 1.0 / weights } else { 0.0 };
    std::array::from_fn(|k| sum[k] * scale + histograms[place][k])
}
