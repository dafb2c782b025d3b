//! Normals from the spread of the points around.

use nalgebra::{Matrix3, Point3, Vector3};

use super::FeatureError;
use super::around::{Around, Neighborhood, Others};
use super::door::{check_place, check_points};
use crate::interrupt::{Interrupt, Phase};
use crate::kernels::spread::least_axis;

/// The normal of each point: across the plane through its neighbours, by PCA (Hoppe et al. 1992).
///
/// With a viewpoint normals face it. Without one, of the two directions that with z above 0 is taken (with y, with x,
/// where those before are 0): they are unoriented. A point without at least two neighbours apart from it has no plane:
/// its normal is the direction to the viewpoint, or +z.
///
/// # Errors
/// If a coordinate is not finite, if the radius is not above 0 or fewer than 3 neighbours may count.
///
/// # Complexity
/// O(n k) time for k points around each; about 60 bytes a point beside the result.
pub fn estimate_normals(
    points: &[Point3<f64>],
    neighborhood: Neighborhood,
    viewpoint: Option<Point3<f64>>,
    interrupt: &Interrupt,
) -> Result<Vec<Vector3<f64>>, FeatureError> {
    check_points("points", points)?;
    check_place("viewpoint", viewpoint.as_ref())?;
    neighborhood.check(3, "at least 3, the point itself among them")?;
    if !interrupt.enter(Phase::Normals) {
        return Err(FeatureError::Interrupted);
    }
    let around = Around::new(points, neighborhood, interrupt)?;
    let places: Vec<u32> = (0..points.len() as u32).collect();
    let sorted = around.map(
        &places,
        interrupt,
        #[inline(always)]
        |place, others, (): &mut ()| {
            let to_eye = viewpoint.map(|eye| eye - Point3::from(around.point(place)));
            normal(&around, place, others, to_eye)
        },
    )?;
    let mut normals = vec![Vector3::zeros(); points.len()];
    for (&row, normal) in around.order().iter().zip(sorted) {
        normals[row as usize] = normal;
    }
    Ok(normals)
}

#[inline(always)]
#[allow(clippy::inline_always)] // into a loop for the vector units
fn normal(around: &Around, place: usize, others: &Others, to_eye: Option<Vector3<f64>>) -> Vector3<f64> {
    let q = around.point(place);
    let (mut sum, mut squares) = ([0.0; 3], [0.0; 6]);
    for &other in others.places() {
        let p = around.point(other as usize);
        let d = [p[0] - q[0], p[1] - q[1], p[2] - q[2]];
        for k in 0..3 {
            sum[k] += d[k];
            squares[k] += d[k] * d[k];
            squares[k + 3] += d[k] * d[(k + 1) % 3];
        }
    }
    let mean = Vector3::from(sum) / (others.places().len() + 1) as f64;
    let [xx, yy, zz, xy, yz, zx] = squares;
    let spread = Matrix3::new(xx, xy, zx, xy, yy, yz, zx, yz, zz) - Vector3::from(sum) * mean.transpose();
    let plane = if others.places().len() < 2 { None } else { least_axis(&spread) };
    match (plane, to_eye) {
        (Some(n), Some(eye)) => n * if n.dot(&eye) < 0.0 { -1.0 } else { 1.0 },
        (Some(n), None) => n * if (n.z, n.y, n.x) < (0.0, 0.0, 0.0) { -1.0 } else { 1.0 },
        // An eye at the point sees nothing of it.
        (None, eye) => eye.and_then(|eye| eye.try_normalize(0.0)).unwrap_or_else(Vector3::z),
    }
}
