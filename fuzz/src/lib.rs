//! Odd inputs, drawn from the bytes of the fuzzer, and what must hold of every answer.

use arbitrary::{Result, Unstructured};
use ibi_core::nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion, Vector3};
use ibi_core::{Params, Registration};
use serde_json::Value;

/// A number as users have them, or as nobody should.
pub fn number(u: &mut Unstructured<'_>) -> Result<f64> {
    const ODD: [f64; 9] =
        [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -0.0, f64::MIN_POSITIVE, 5e-324, f64::MAX, 1e9, 1e-9];
    if u.ratio(1, 32)? { Ok(*u.choose(&ODD)?) } else { finite(u) }
}

/// A number of any size.
pub fn finite(u: &mut Unstructured<'_>) -> Result<f64> {
    Ok(match u.int_in_range(0..=31_u8)? {
        0..=11 => f64::from(u.arbitrary::<i16>()?) / 1024.0,
        12..=19 => f64::from(u.int_in_range(-2..=2_i8)?),
        20..=26 => f64::from(u.arbitrary::<i32>()?) / f64::from(1 << 29),
        27..=29 => 5e5 + f64::from(u.arbitrary::<i16>()?) / 1024.0,
        _ => f64::from(u.int_in_range(-9..=9_i8)?) * 10_f64.powi(u.int_in_range(-300..=300)?),
    })
}

/// A number that is finite and of no extreme size: most are, or all calls would be refused.
pub fn tame(u: &mut Unstructured<'_>) -> Result<f64> {
    Ok(f64::from(u.arbitrary::<i16>()?) / 4096.0)
}

/// So many rows: tame ones, but for a few; some of them repeated.
pub fn rows(u: &mut Unstructured<'_>, most: usize) -> Result<Vec<[f64; 3]>> {
    let len = u.int_in_range(0..=most)?;
    let kind = u.int_in_range(0..=15_u8)?;
    let scale = if u.ratio(1, 8)? { 10_f64.powi(u.int_in_range(-12..=12)?) } else { 1.0 };
    let mut rows: Vec<[f64; 3]> = Vec::with_capacity(len);
    for i in 0..len {
        if i > 0 && u.ratio(1, 8)? {
            rows.push(rows[u.int_in_range(0..=i - 1)?]);
        } else if kind == 0 {
            rows.push([number(u)?, number(u)?, number(u)?]);
        } else if kind < 4 {
            rows.push([finite(u)?, finite(u)?, finite(u)?]);
        } else {
            rows.push([scale * tame(u)?, scale * tame(u)?, scale * tame(u)?]);
        }
    }
    Ok(rows)
}

/// As [`rows`].
pub fn points(u: &mut Unstructured<'_>, most: usize) -> Result<Vec<Point3<f64>>> {
    Ok(rows(u, most)?.into_iter().map(Point3::from).collect())
}

/// Unit vectors, but for a few.
pub fn normals(u: &mut Unstructured<'_>, len: usize) -> Result<Vec<Vector3<f64>>> {
    let is_wild = u.ratio(1, 16)?;
    let normal = |_| {
        let n = if is_wild {
            Vector3::new(number(u)?, number(u)?, number(u)?)
        } else {
            Vector3::new(tame(u)?, tame(u)?, tame(u)?)
        };
        Ok(if is_wild { n } else { n.try_normalize(0.0).unwrap_or_else(Vector3::x) })
    };
    (0..len).map(normal).collect()
}

/// A rigid motion.
pub fn motion(u: &mut Unstructured<'_>) -> Result<Isometry3<f64>> {
    let q = Quaternion::new(tame(u)?, tame(u)?, tame(u)?, tame(u)?);
    let turn = UnitQuaternion::try_new(q, 1e-6).unwrap_or_default();
    Ok(Isometry3::from_parts(Translation3::new(tame(u)?, tame(u)?, tame(u)?), turn))
}

/// A preset with other variants in its stages and other numbers in some places; `None` where no parameters can be read
/// from that.
pub fn params(u: &mut Unstructured<'_>) -> Result<Option<Params>> {
    use ibi_core::stages::{ce::Ce, hv::Hv, scs::Scs, te::Te};
    let presets = [Params::default(), Params::single_view(), Params::paper_synthetic(), Params::paper_real()];
    let mut params = u.choose(&presets)?.clone();
    if u.arbitrary()? {
        params.scs = u.choose(&Scs::all())?.clone();
        params.ce = u.choose(&Ce::all())?.clone();
        params.te = u.choose(&Te::all())?.clone();
        params.hv = u.choose(&Hv::all())?.clone();
    }
    let Ok(mut plain) = serde_json::to_value(&params) else { unreachable!("parameters are plain data") };
    let num_odd = if u.ratio(1, 2)? { u.int_in_range(1..=4)? } else { 0 };
    for _ in 0..num_odd {
        let mut leaves = Vec::new();
        leaves_of(&mut plain, &mut leaves);
        let at = u.int_in_range(0..=leaves.len() - 1)?;
        *leaves[at] = match u.int_in_range(0..=4)? {
            0 => Value::from(u.arbitrary::<u32>()?),
            1 => Value::from(u.int_in_range(0..=20_u8)?),
            2 => Value::from(number(u)?),
            3 => Value::from(u.arbitrary::<bool>()?),
            _ => Value::Null,
        };
    }
    Ok(serde_json::from_value(plain).ok())
}

fn leaves_of<'v>(value: &'v mut Value, leaves: &mut Vec<&'v mut Value>) {
    if let Value::Object(inner) = value {
        inner.values_mut().for_each(|inner| leaves_of(inner, leaves));
    } else {
        leaves.push(value);
    }
}

/// What must hold of every result, whatever the input.
///
/// # Panics
/// Where it does not.
pub fn check(found: &Registration, num_correspondences: usize) {
    assert_eq!(found.labels.len(), num_correspondences);
    for label in found.labels.iter().flatten() {
        assert!((*label as usize) < found.poses.len(), "label {label}");
    }
    for pose in &found.poses {
        check_rigid(&pose.target_from_source);
        for (name, value) in [("score", pose.score), ("overlap", pose.overlap), ("back_fit", pose.back_fit)] {
            assert!((0.0..=1.0).contains(&value), "{name} is {value}");
        }
        assert!(pose.closeness.is_finite(), "closeness is {}", pose.closeness);
        assert!(pose.evidence >= 0.0 && pose.inlier_rmse >= 0.0 && pose.inlier_rmse.is_finite());
        assert!(
            pose.inliers.is_sorted() && pose.inliers.iter().all(|&id| (id as usize) < num_correspondences)
        );
    }
    assert!(found.poses.is_sorted_by(|a, b| a.score >= b.score));
}

/// # Panics
/// If a pose is none.
pub fn check_rigid(pose: &Isometry3<f64>) {
    let rotation = pose.rotation.to_rotation_matrix();
    let off = (rotation.matrix() * rotation.matrix().transpose()).add_scalar(0.0);
    assert!((off - ibi_core::nalgebra::Matrix3::identity()).amax() < 1e-9, "not rigid: {pose}");
    assert!(rotation.matrix().determinant() > 0.0 && pose.translation.vector.iter().all(|x| x.is_finite()));
}

/// All that a result says but for how long it took, to the bit.
#[must_use]
pub fn bits(found: &Registration) -> Vec<u64> {
    let mut bits: Vec<u64> = vec![found.resolution.to_bits(), found.rounds.len() as u64];
    bits.extend(found.labels.iter().map(|label| label.map_or(u64::MAX, u64::from)));
    for pose in &found.poses {
        bits.extend(pose.target_from_source.to_homogeneous().iter().map(|x| x.to_bits()));
        let numbers =
            [pose.score, pose.overlap, pose.closeness, pose.back_fit, pose.evidence, pose.inlier_rmse];
        bits.extend(numbers.map(f64::to_bits));
        bits.extend(pose.inliers.iter().map(|&id| u64::from(id)));
    }
    bits
}
