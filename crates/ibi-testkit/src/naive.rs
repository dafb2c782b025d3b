//! The kernels once more, in `f64`, written as their definitions read: no lanes, no trees, no early exits.

use nalgebra::{Isometry3, Matrix3, Point3, Translation3, UnitQuaternion, Vector3};

/// One correspondence: (source point, target point).
pub type Pair = (Point3<f64>, Point3<f64>);

/// The payoff of two correspondences.
#[derive(Debug, Clone, Copy)]
pub enum Payoff {
    /// exp(-r^2 / `delta_r`^2).
    Gaussian {
        /// Width, in data units.
        delta_r: f64,
    },
    /// min(a/b, b/a).
    Ratio,
}

/// The payoff of i and j; 0 where they share a point.
#[must_use]
pub fn payoff(i: &Pair, j: &Pair, payoff: Payoff) -> f64 {
    let (a, b) = ((i.0 - j.0).norm(), (i.1 - j.1).norm());
    if a == 0.0 || b == 0.0 {
        return 0.0;
    }
    match payoff {
        Payoff::Gaussian { delta_r } => (-((a - b) / delta_r).powi(2)).exp(),
        Payoff::Ratio => (a / b).min(b / a),
    }
}

/// All payoffs, row-major n x n.
#[must_use]
pub fn payoff_matrix(pairs: &[Pair], kind: Payoff) -> Vec<f64> {
    pairs.iter().flat_map(|i| pairs.iter().map(|j| payoff(i, j, kind))).collect()
}

/// For each candidate the sum of the voters' gaussian payoffs.
#[must_use]
pub fn votes(candidates: &[Pair], voters: &[Pair], delta_r: f64) -> Vec<f64> {
    let votes = |c| voters.iter().map(|v| payoff(c, v, Payoff::Gaussian { delta_r })).sum();
    candidates.iter().map(votes).collect()
}

/// `steps` synchronous generations from the uniform population; `None` once nobody gains anything.
#[must_use]
pub fn replicator(payoff: &[f64], n: usize, steps: usize) -> Option<Vec<f64>> {
    let mut x = vec![1.0 / n as f64; n];
    for _ in 0..steps {
        let gain: Vec<f64> = (0..n).map(|i| (0..n).map(|j| payoff[i * n + j] * x[j]).sum()).collect();
        let mean: f64 = (0..n).map(|i| x[i] * gain[i]).sum();
        if mean == 0.0 {
            return None;
        }
        x = (0..n).map(|i| x[i] * gain[i] / mean).collect();
    }
    Some(x)
}

/// The bin of `value` in a histogram of `bins` bins over 0..=max.
fn bin(value: f32, max: f64, bins: usize) -> usize {
    ((f64::from(value) / max * bins as f64) as usize).min(bins - 1)
}

/// Otsu's criterion for the split "bins below `edge`, bins from `edge` on", counted afresh; `None` if a class
/// is empty.
#[must_use]
pub fn between_class_variance(values: &[f32], bins: usize, edge: usize) -> Option<f64> {
    let max = values.iter().copied().fold(0.0, f32::max).into();
    let (lower, upper): (Vec<usize>, Vec<usize>) =
        values.iter().map(|&v| bin(v, max, bins)).partition(|&b| b < edge);
    let mean = |class: &[usize]| class.iter().sum::<usize>() as f64 / class.len() as f64;
    let (n, m) = (lower.len() as f64, upper.len() as f64);
    (n * m > 0.0).then(|| n * m * (mean(&lower) - mean(&upper)).powi(2))
}

/// The first bin edge (as a number of bins) of largest between-class variance, by trying them all.
#[must_use]
pub fn otsu_edge(values: &[f32], bins: usize) -> Option<usize> {
    let mut best: Option<(f64, usize)> = None;
    for edge in 1..bins {
        if let Some(variance) = between_class_variance(values, bins, edge)
            && best.is_none_or(|(top, _)| variance > top)
        {
            best = Some((variance, edge));
        }
    }
    best.map(|(_, edge)| edge)
}

/// All triplets i < j < k, largest sum of scores first, ties in lexicographic order.
#[must_use]
pub fn top_triplets(scores: &[f32]) -> Vec<[usize; 3]> {
    let n = scores.len();
    let mut all: Vec<[usize; 3]> =
        (0..n).flat_map(|i| (i + 1..n).flat_map(move |j| (j + 1..n).map(move |k| [i, j, k]))).collect();
    let sum = |t: &[usize; 3]| scores[t[0]] + scores[t[1]] + scores[t[2]];
    all.sort_by(|a, b| sum(b).total_cmp(&sum(a)).then(a.cmp(b)));
    all
}

/// The local reference frame at `centre` among `points`, its axes as rows: x, y, z of descending weighted spread, x and z to
/// the side of the majority. And how far it is from another answer: 0 where rounding may decide.
#[must_use]
pub fn frame(points: &[Point3<f64>], centre: &Point3<f64>, radius: f64) -> Option<(Matrix3<f64>, f64)> {
    let offsets: Vec<Vector3<f64>> = points.iter().map(|p| p - centre).collect();
    let inside: Vec<&Vector3<f64>> = offsets.iter().filter(|d| d.norm() > 0.0 && d.norm() < radius).collect();
    let spread: Matrix3<f64> = inside.iter().map(|d| (radius - d.norm()) * **d * d.transpose()).sum();
    let svd = spread.svd(true, false);
    let (u, s) = (svd.u.filter(|_| inside.len() >= 4)?, svd.singular_values);
    let mut margin = (s[0] - s[1]).min(s[1] - s[2]) / s[0];
    for d in &offsets {
        margin = margin.min((d.norm() - radius).abs() / radius);
    }
    let mut towards_most = |axis: Vector3<f64>| {
        let along: Vec<f64> = inside.iter().map(|d| axis.dot(d)).collect();
        let undecided = along.iter().filter(|a| a.abs() < 1e-9 * radius).count();
        let positive = along.iter().filter(|&&a| a >= 0.0).count();
        let pull: f64 = inside.iter().zip(&along).map(|(d, a)| (radius - d.norm()) * a).sum();
        if 2 * positive == along.len() {
            margin = margin.min(pull.abs() / (radius * radius * along.len() as f64));
        }
        if undecided > 0 {
            margin = 0.0;
        }
        let is_turned = 2 * positive < along.len() || (2 * positive == along.len() && pull < 0.0);
        if is_turned { -axis } else { axis }
    };
    let (x, z) = (towards_most(u.column(0).into()), towards_most(u.column(2).into()));
    Some((Matrix3::from_rows(&[x.transpose(), z.cross(&x).transpose(), z.transpose()]), margin))
}

/// What each vote adds to the cell with the given corner: 1 at its centre, falling to 0 a width away along each axis.
#[must_use]
pub fn hough_shares(votes: &[[f64; 3]], cell: [i64; 3], width: f64) -> Vec<f64> {
    let tent = |x: f64, c: i64| (1.0 - (x / width - (c as f64 + 0.5)).abs()).max(0.0);
    votes.iter().map(|vote| (0..3).map(|axis| tent(vote[axis], cell[axis])).product()).collect()
}

/// Second-order weights of a graph, row-major n x n: w_ij * sum over k of w_ik w_kj.
#[must_use]
pub fn second_order(weights: &[f32], n: usize) -> Vec<f64> {
    let w = |i: usize, j: usize| f64::from(weights[i * n + j]);
    let second = |i, j| w(i, j) * (0..n).map(|k| w(i, k) * w(k, j)).sum::<f64>();
    (0..n).flat_map(|i| (0..n).map(move |j| (i, j))).map(|(i, j)| second(i, j)).collect()
}

/// All triangles of a graph given by its weights, row-major n x n, 0 without an edge; and the sum of the weights of each.
#[must_use]
pub fn triangles(weights: &[f32], n: usize) -> Vec<([u32; 3], f64)> {
    let w = |i: usize, j: usize| f64::from(weights[i * n + j]);
    let all = (0..n).flat_map(|i| (i + 1..n).flat_map(move |j| (j + 1..n).map(move |k| [i, j, k])));
    let closed = all.filter(|&[i, j, k]| w(i, j) > 0.0 && w(i, k) > 0.0 && w(j, k) > 0.0);
    closed.map(|t| (t.map(|i| i as u32), w(t[0], t[1]) + w(t[0], t[2]) + w(t[1], t[2]))).collect()
}

/// All maximal cliques of three nodes or more, by trying each set of nodes; for graphs of a dozen.
#[must_use]
pub fn maximal_cliques(weights: &[f32], n: usize) -> Vec<Vec<u32>> {
    let joined = |i: usize, j: usize| weights[i * n + j] > 0.0;
    let has = |set: u32, i: usize| set >> i & 1 == 1;
    let is_clique = |set: u32| (0..n).all(|i| (0..i).all(|j| !has(set, i) || !has(set, j) || joined(i, j)));
    let is_maximal = |set: u32| (0..n).all(|i| has(set, i) || !is_clique(set | 1 << i));
    let sets = (0..1_u32 << n).filter(|&set| set.count_ones() >= 3 && is_clique(set) && is_maximal(set));
    sets.map(|set| (0..n as u32).filter(|&i| has(set, i as usize)).collect()).collect()
}

/// The sum of the weights of a clique.
#[must_use]
pub fn clique_weight(weights: &[f32], n: usize, clique: &[u32]) -> f64 {
    let pairs = clique.iter().flat_map(|&i| clique.iter().map(move |&j| (i, j))).filter(|(i, j)| i < j);
    pairs.map(|(i, j)| f64::from(weights[i as usize * n + j as usize])).sum()
}

/// |T p - q| of each pair.
#[must_use]
pub fn residuals(pairs: &[Pair], pose: &Isometry3<f64>) -> Vec<f64> {
    pairs.iter().map(|(p, q)| (pose * p - q).norm()).collect()
}

/// sum of (`t_he` - e) / `t_he` over the residuals e below `t_he`.
#[must_use]
pub fn mae(pairs: &[Pair], pose: &Isometry3<f64>, t_he: f64) -> f64 {
    residuals(pairs, pose).iter().filter(|&&e| e < t_he).map(|e| (t_he - e) / t_he).sum()
}

/// Rows of the pairs with a residual below `t_he`, ascending.
#[must_use]
pub fn close_pairs(pairs: &[Pair], pose: &Isometry3<f64>, t_he: f64) -> Vec<u32> {
    let residuals = residuals(pairs, pose);
    (0..pairs.len() as u32).filter(|&row| residuals[row as usize] < t_he).collect()
}

/// The squared distance to the nearest of `points`; infinite for none.
#[must_use]
pub fn nearest_dist_sq(points: &[Point3<f64>], query: &Point3<f64>) -> f64 {
    points.iter().map(|p| (p - query).norm_squared()).fold(f64::INFINITY, f64::min)
}

/// Rows of the points within `distance` of the query, ascending.
#[must_use]
pub fn within(points: &[Point3<f64>], query: &Point3<f64>, distance: f64) -> Vec<u32> {
    (0..points.len() as u32).filter(|&row| (points[row as usize] - query).norm() <= distance).collect()
}

/// Mean distance of a point to the nearest other one; 0 for fewer than two.
#[must_use]
pub fn mean_spacing(points: &[Point3<f64>]) -> f64 {
    if points.len() < 2 {
        return 0.0;
    }
    let nearest_other = |i: usize| {
        let others = points.iter().enumerate().filter(|&(j, _)| j != i);
        others.map(|(_, p)| (p - points[i]).norm()).fold(f64::INFINITY, f64::min)
    };
    (0..points.len()).map(nearest_other).sum::<f64>() / points.len() as f64
}

/// Share of the moved source points with a target point within `d_op`.
#[must_use]
pub fn overlap(source: &[Point3<f64>], target: &[Point3<f64>], pose: &Isometry3<f64>, d_op: f64) -> f64 {
    let close = |p: &&Point3<f64>| target.iter().any(|q| (pose * **p - q).norm() <= d_op);
    source.iter().filter(close).count() as f64 / source.len() as f64
}

/// Points, and their normals where those count.
pub type Surface<'a> = (&'a [Point3<f64>], Option<&'a [Vector3<f64>]>);

/// Least and largest mean over the moved source points of max(0, 1 - d / reach), d being the distance to the nearest
/// target point, if that is not `claimed` and the cosine of the normals (or its magnitude, if they are not
/// `oriented`) is at least `min_cos`. Two values, because which of equally near points it is nobody says.
#[must_use]
pub fn fit(
    (source, normals): Surface<'_>,
    (target, target_normals): Surface<'_>,
    claimed: &[bool],
    pose: &Isometry3<f64>,
    reach: f64,
    (min_cos, oriented): (f64, bool),
) -> (f64, f64) {
    let (mut least, mut most) = (0.0, 0.0);
    for (i, point) in source.iter().enumerate() {
        let moved = pose * point;
        let nearest = nearest_dist_sq(target, &moved).sqrt();
        let counts = |row: usize| {
            let cos = normals.zip(target_normals).map_or(1.0, |(n, m)| (pose * n[i]).dot(&m[row]));
            !claimed[row] && if oriented { cos } else { cos.abs() } >= min_cos
        };
        let ties = within(target, &moved, nearest + 1e-9);
        let near = (1.0 - nearest / reach).max(0.0);
        least += if ties.iter().all(|&row| counts(row as usize)) { near } else { 0.0 };
        most += if ties.iter().any(|&row| counts(row as usize)) { near } else { 0.0 };
    }
    let n = source.len().max(1) as f64;
    (least / n, most / n)
}

/// -log10 P[Bin(n, p) >= k], summed up term by term.
#[must_use]
pub fn binomial_surprise(n: u32, k: u32, p: f64) -> f64 {
    let mut ln_choose = 0.0; // of n over i
    let mut terms = Vec::new();
    for i in 0..=n {
        let (i_f, n_f) = (f64::from(i), f64::from(n));
        if i >= k {
            terms.push(ln_choose + i_f * p.ln() + (n_f - i_f) * (-p).ln_1p());
        }
        ln_choose += ((n_f - i_f) / (i_f + 1.0)).ln();
    }
    let largest = terms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let sum: f64 = terms.iter().map(|term| (term - largest).exp()).sum();
    -(largest + sum.ln()) / std::f64::consts::LN_10
}

/// The sum of squared residuals, what a rigid fit minimises.
#[must_use]
pub fn cost(pairs: &[Pair], pose: &Isometry3<f64>) -> f64 {
    residuals(pairs, pose).iter().map(|e| e * e).sum()
}

/// The lowest cost among poses near `pose`: each of its six degrees of freedom turned (about the target's
/// mean) and shifted both ways by several steps, the largest being `size` (radians, and `size` x `length`).
#[must_use]
pub fn lowest_cost_nearby(pairs: &[Pair], pose: &Isometry3<f64>, size: f64, length: f64) -> f64 {
    let centre = pairs.iter().map(|(_, q)| q.coords).sum::<Vector3<f64>>() / pairs.len() as f64;
    let to_centre = Translation3::from(centre);
    let mut lowest = f64::INFINITY;
    for axis in [Vector3::x(), Vector3::y(), Vector3::z()] {
        for step in [size, -size, 0.1 * size, -0.1 * size, 0.01 * size, -0.01 * size] {
            let turn = to_centre * UnitQuaternion::new(axis * step) * to_centre.inverse();
            let shift = Translation3::from(axis * (step * length));
            lowest = lowest.min(cost(pairs, &(turn * pose))).min(cost(pairs, &(shift * pose)));
        }
    }
    lowest
}

/// The smallest distance of a corner to the line through the other two.
#[must_use]
pub fn triangle_height(a: &Point3<f64>, b: &Point3<f64>, c: &Point3<f64>) -> f64 {
    let to_line = |p: &Point3<f64>, u: &Point3<f64>, v: &Point3<f64>| {
        let Some(along) = (v - u).try_normalize(0.0) else { return 0.0 };
        let w = p - u;
        (w - along * w.dot(&along)).norm()
    };
    to_line(a, b, c).min(to_line(b, c, a)).min(to_line(c, a, b))
}

/// What joins two correspondences in the compatibility graph, in data units.
#[derive(Debug, Clone, Copy)]
pub struct EdgeTest {
    /// The rigidity stays below this.
    pub tau: f64,
    /// Both lengths exceed this.
    pub min_length: f64,
    /// The length on the target's side stays below this.
    pub max_length: f64,
    /// How far the cosines of [`angles`] may differ between the sides.
    pub normal_tolerance: f64,
}

/// By how much the lengths between i and j pass the test: they are joined where
/// this is positive.
#[must_use]
pub fn edge_margin(i: &Pair, j: &Pair, test: &EdgeTest) -> f64 {
    let (a, b) = ((i.0 - j.0).norm(), (i.1 - j.1).norm());
    [test.tau - (a - b).abs(), a - test.min_length, b - test.min_length, test.max_length - b]
        .into_iter()
        .fold(f64::INFINITY, f64::min)
}

/// w = 1 - (r / `tau`)^2.
#[must_use]
pub fn edge_weight(i: &Pair, j: &Pair, tau: f64) -> f64 {
    1.0 - (((i.0 - j.0).norm() - (i.1 - j.1).norm()) / tau).powi(2)
}

/// The cosines between two oriented points: normal and normal, each normal and the line that joins them.
#[must_use]
pub fn angles(a: (&Point3<f64>, &Vector3<f64>), b: (&Point3<f64>, &Vector3<f64>)) -> [f64; 3] {
    let along = (b.0 - a.0).normalize();
    [a.1.dot(b.1), a.1.dot(&along), b.1.dot(&along)]
}

/// Outward normals of a closed surface around the origin: across the plane of each point and its eight nearest.
#[must_use]
pub fn outward_normals(points: &[Point3<f64>]) -> Vec<Vector3<f64>> {
    let normal = |p: &Point3<f64>| {
        let mut around: Vec<Vector3<f64>> = points.iter().map(|q| q - p).collect();
        around.sort_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()));
        around.truncate(9);
        let mean = around.iter().sum::<Vector3<f64>>() / around.len() as f64;
        let spread: Matrix3<f64> = around.iter().map(|d| (d - mean) * (d - mean).transpose()).sum();
        let eigen = spread.symmetric_eigen();
        let across = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
        across * across.dot(&p.coords).signum()
    };
    points.iter().map(normal).collect()
}

/// How far the farthest moved point is from the nearest unmoved one: all distances of all.
#[must_use]
pub fn farthest_off(points: &[Point3<f64>], motion: &Isometry3<f64>) -> f64 {
    points.iter().map(|p| nearest_dist_sq(points, &(motion * p)).sqrt()).fold(0.0, f64::max)
}
