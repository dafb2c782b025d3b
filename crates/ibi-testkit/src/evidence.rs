//! The measures of a pose once more, as their definitions read: every point against every other.

use nalgebra::{Isometry3, Matrix6, Point3, Vector3, Vector6};

/// What an eye says of a point on a surface, in the words of the definition.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Seen {
    Unknown,
    Hidden,
    Buried,
    Contradicted,
    Supported,
}

/// Rows of the points that an eye saw in a direction within `angle` of that to `at`, ascending; and how far that is from another
/// answer, radians: where it is tiny, rounding may decide.
#[must_use]
pub fn rays_near(eye: &Point3<f64>, points: &[Point3<f64>], at: &Point3<f64>, angle: f64) -> (Vec<u32>, f64) {
    let mut margin = f64::INFINITY;
    let mut near = Vec::new();
    for (row, point) in (0..).zip(points) {
        let (a, b) = (point - eye, at - eye);
        if a.norm() > 0.0 && b.norm() > 0.0 {
            let between = a.cross(&b).norm().atan2(a.dot(&b));
            margin = margin.min((between - angle).abs());
            if between <= angle {
                near.push(row);
            }
        }
    }
    (near, margin)
}

/// What the points near the ray to `at` say of a surface there, and their gap: the mean of those that support it, or else the
/// least. Buried is what lies less than `buried` behind all of them.
#[must_use]
pub fn look(
    near: &[Point3<f64>],
    at: &Point3<f64>,
    normal: &Vector3<f64>,
    across: f64,
    buried: f64,
) -> (Seen, f64) {
    let gaps: Vec<f64> = near.iter().map(|p| normal.dot(&(p - at))).collect();
    let Some(&nearest) = gaps.iter().min_by(|a, b| a.abs().total_cmp(&b.abs())) else {
        return (Seen::Unknown, 0.0);
    };
    let within: Vec<f64> = gaps.iter().copied().filter(|gap| gap.abs() <= across).collect();
    if !within.is_empty() {
        return (Seen::Supported, within.iter().sum::<f64>() / within.len() as f64);
    }
    let seen = if gaps.iter().all(|&gap| gap < -across) {
        Seen::Contradicted
    } else if gaps.iter().all(|&gap| gap > across) {
        if gaps.iter().any(|&gap| gap < buried) { Seen::Buried } else { Seen::Hidden }
    } else {
        Seen::Unknown
    };
    (seen, nearest)
}

/// Which places in the tangent planes of points, `reach` away in a direction, lie beyond their surface: (row, place).
#[must_use]
pub fn is_beyond(
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    place: &Point3<f64>,
    fallen: f64,
    within: f64,
) -> bool {
    let nearest =
        (0..points.len()).min_by(|&a, &b| (place - points[a]).norm().total_cmp(&(place - points[b]).norm()));
    nearest.is_none_or(|row| {
        let gap = place - points[row];
        gap.norm() > fallen && gap.dot(&normals[row]) > -within
    })
}

/// How the distances of points from their planes change with a small motion about a centre, by finite differences: the sum of
/// j j^T / noise^2.
#[must_use]
pub fn information(
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    centre: &Point3<f64>,
    noise: f64,
) -> Matrix6<f64> {
    let mut sum = Matrix6::zeros();
    for (point, normal) in points.iter().zip(normals) {
        let distance = |motion: &Vector6<f64>| {
            let turn = nalgebra::Rotation3::new(motion.fixed_rows::<3>(0).into_owned());
            let moved = centre + turn * (point - centre) + motion.fixed_rows::<3>(3);
            normal.dot(&(moved - point))
        };
        let step = 1e-6;
        let slope = Vector6::from_fn(|k, _| {
            let motion = Vector6::ith(k, step);
            (distance(&motion) - distance(&-motion)) / (2.0 * step)
        });
        sum += slope * slope.transpose() / (noise * noise);
    }
    sum
}

/// Root mean square distance of the 12 points nearest to one, itself among them, from the plane through them, for 9 degrees of
/// freedom.
#[must_use]
pub fn roughness(points: &[Point3<f64>], far: impl Fn(&Point3<f64>) -> f64) -> f64 {
    let mut near: Vec<&Point3<f64>> = points.iter().collect();
    near.sort_by(|a, b| far(a).total_cmp(&far(b)));
    let near = &near[..12];
    let middle = near.iter().map(|p| p.coords).sum::<Vector3<f64>>() / 12.0;
    let offsets = nalgebra::Matrix3xX::from_iterator(
        12,
        near.iter().flat_map(|p| {
            let d = p.coords - middle;
            [d.x, d.y, d.z]
        }),
    );
    let least = offsets.svd(false, false).singular_values.min();
    least / 3.0
}

/// Rows of a scan that a surface explains once it has been moved: the nearest of its points that one of the eyes can see, or of all
/// without eyes, is within reach across its tangent plane, and no farther than the diagonal of both reaches.
#[must_use]
pub fn explained(
    (points, normals): (&[Point3<f64>], &[Vector3<f64>]),
    pose: &Isometry3<f64>,
    eyes: &[Point3<f64>],
    least_cos: f64,
    scan: &[Point3<f64>],
    [across, aside]: [f64; 2],
) -> Vec<u32> {
    let moved: Vec<_> = points.iter().zip(normals).map(|(p, n)| (pose * p, pose * n)).collect();
    let sees =
        |eye: &Point3<f64>, (p, n): &(Point3<f64>, Vector3<f64>)| (eye - p).normalize().dot(n) > least_cos;
    let seen = moved.iter().filter(|at| eyes.is_empty() || eyes.iter().any(|eye| sees(eye, at)));
    let seen: Vec<_> = seen.collect();
    let is_explained = |q: &Point3<f64>| {
        let nearest = seen.iter().min_by(|a, b| (q - a.0).norm().total_cmp(&(q - b.0).norm()));
        nearest.is_some_and(|(p, n)| (q - p).norm() <= across.hypot(aside) && (q - p).dot(n).abs() <= across)
    };
    (0..).zip(scan).filter(|(_, q)| is_explained(q)).map(|(row, _)| row).collect()
}

/// How far a measured point, with a unit vector from there to its eye, lies in front of the plane of the nearest of the `model`'s
/// points, once a pose has moved them; `None` if that is more than `across`, or more than `aside` along the plane, or if the plane is
/// seen at a cosine of no more than `facing`. And how far that is from another answer.
#[must_use]
pub fn touch(
    (points, normals): (&[Point3<f64>], &[Vector3<f64>]),
    (at, to_eye): (&Point3<f64>, &Vector3<f64>),
    pose: &Isometry3<f64>,
    across: f64,
    aside: f64,
    facing: f64,
) -> (Option<f64>, f64) {
    let mut order: Vec<(f64, usize)> =
        points.iter().enumerate().map(|(row, p)| ((pose * p - at).norm(), row)).collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (_, row) = order[0];
    let lead = order.get(1).map_or(f64::INFINITY, |next| next.0 - order[0].0);
    let (normal, off) = (pose * normals[row], at - pose * points[row]);
    let gap = off.dot(&normal);
    let along = (off - gap * normal).norm();
    let cosine = normal.dot(to_eye);
    let margins = [lead, (gap.abs() - across).abs(), (along - aside).abs(), (cosine - facing).abs()];
    let is_on = gap.abs() <= across && along <= aside && cosine > facing;
    (is_on.then_some(gap), margins.into_iter().fold(f64::INFINITY, f64::min))
}
