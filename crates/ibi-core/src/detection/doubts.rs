//! What makes a scan doubtful: told, or refused, instead of found wrongly in silence.
//!
//! Each number was chosen on ray-cast piles and on the scans of `examples`: `tests/test_scans.py` has the cases.

use std::fmt;

use nalgebra::Point3;

use super::bodies::Body;
use super::extent::extent;
use super::{DetectionError, sides};

/// A scene so many models wide is in another unit: millimetres for metres are a factor of 1000.
const MIN_EXTENTS: f64 = 0.1;
const MAX_EXTENTS: f64 = 300.0;

/// Fewer points tell nothing of the unit: an empty bin, and stray points.
pub(super) const ENOUGH: usize = 100;

/// Between metres, centimetres, millimetres and inches, one way and the other.
const FACTORS: [f64; 5] = [1000.0, 100.0, 25.4, 10.0, 2.54];

/// Of what stands out of a scan to the model: in part hidden, or two that touch. Less is no body.
const RATIOS: std::ops::RangeInclusive<f64> = 0.5..=2.0;
const FEW_CELLS: usize = 8;

/// Share of given normals that may face away from the viewpoint, and of points that may lie behind others.
const MAX_AWAY: f64 = 0.01;
const MAX_HIDDEN: f64 = 0.04;

/// Share of model points that are seen from their backs only. Thin walls, seen through, have up to 0.17.
pub(super) const MAX_INWARD: f64 = 0.25;

/// Something that a result is to be mistrusted for. Lengths are in data units; what is written is one line.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Doubt {
    /// Rows of the scan are not finite.
    NotFinite {
        /// How many were left out.
        num_dropped: usize,
        /// Of how many.
        num_given: usize,
    },
    /// Too few points for a pose.
    FewPoints {
        /// How many.
        num_points: usize,
    },
    /// Too few points for a pose lie in the box to look into.
    FewInRoi {
        /// How many.
        num_points: usize,
        /// Of how many.
        num_given: usize,
    },
    /// There is a table, or there are stray points, and nothing else.
    Nothing,
    /// Too little is left of the model at what the scan can carry; nothing is looked for.
    TooCoarse {
        /// What the scan was thinned to.
        voxel: f64,
        /// Of the model.
        diameter: f64,
    },
    /// The scan is coarser than the voxel that the user gave the model.
    CoarserThanGiven {
        /// That voxel.
        given: f64,
        /// What the scan was thinned to.
        voxel: f64,
    },
    /// The model is few voxels across at what the scan can carry.
    Coarse {
        /// What the scan was thinned to.
        voxel: f64,
        /// Of the model.
        diameter: f64,
    },
    /// Nearly all of the scan lies behind its largest plane, as the viewpoint sees it.
    BehindPlane,
    /// Normals that were given face away from the viewpoint.
    NormalsAway {
        /// Of all.
        share: f64,
    },
    /// Points lie behind others, as the viewpoint sees them.
    Hidden {
        /// Of those that can be judged.
        share: f64,
    },
    /// Normals of a model that is a cloud point inwards.
    NormalsInward {
        /// Of those that are seen from outside.
        share: f64,
    },
    /// Nothing is found, and in another unit the model would fit what stands out of the scan.
    OtherUnit {
        /// How far across a typical body of the scan is.
        body: f64,
        /// Of the model.
        diameter: f64,
        /// By what the model would have to be multiplied, the likeliest first.
        factors: Vec<f64>,
    },
}

impl fmt::Display for Doubt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let short = |value: f64| general(value, 3);
        match *self {
            Self::NotFinite { num_dropped, num_given } => {
                write!(f, "{num_dropped} of {num_given} points of the scan are not finite, and were left out")
            }
            Self::FewPoints { num_points } => write!(f, "the scan has {num_points} points"),
            Self::FewInRoi { num_points, num_given } => {
                write!(f, "roi: {num_points} of the {num_given} points of the scan lie in it")
            }
            Self::Nothing => f.write_str("the scan is a table, or stray points, and nothing else"),
            Self::TooCoarse { voxel, diameter } => write!(
                f,
                "the scan is too coarse, at a voxel of {}, for a model {} across; nothing is looked for",
                short(voxel),
                short(diameter)
            ),
            Self::CoarserThanGiven { given, voxel } => write!(
                f,
                "the scan is coarser than the voxel of {} that the model was given; {} was used",
                short(given),
                short(voxel)
            ),
            Self::Coarse { voxel, diameter } => write!(
                f,
                "the scan is coarse, at a voxel of {}, for a model {} across; poses are less sure",
                short(voxel),
                short(diameter)
            ),
            Self::BehindPlane => f.write_str(
                "viewpoint: nearly all of the scan lies behind its largest plane; is it on the right side?",
            ),
            Self::NormalsAway { share } => write!(
                f,
                "viewpoint: {:.0}% of the normals face away from it; it is another one, or the scan is of several",
                100.0 * share
            ),
            Self::Hidden { share } => write!(
                f,
                "viewpoint: {:.0}% of the scan lie behind other points of it, as seen from there; it is another one, or the scan is of several",
                100.0 * share
            ),
            Self::NormalsInward { share } => write!(
                f,
                "src_normals: {:.0}% of those that are seen from outside point inwards; they have to point outwards",
                100.0 * share
            ),
            Self::OtherUnit { body, diameter, ref factors } => {
                let word = |&factor: &f64| {
                    if factor > 1.0 { general(factor, 6) } else { format!("1/{}", general(1.0 / factor, 6)) }
                };
                write!(
                    f,
                    "nothing is found; what stands out of the scan is {} across and the model {}; in the same unit? The model times {} would fit",
                    short(body),
                    short(diameter),
                    factors.iter().map(word).collect::<Vec<_>>().join(" or ")
                )
            }
        }
    }
}

/// Refuses a whole scan that cannot be in the unit of the model, whose diameter is given.
pub(super) fn check_units(diameter: f64, points: &[Point3<f64>]) -> Result<(), DetectionError> {
    let scene = extent(points);
    if points.len() < ENOUGH || (MIN_EXTENTS * diameter..=MAX_EXTENTS * diameter).contains(&scene) {
        return Ok(());
    }
    Err(DetectionError::DifferentUnits { scene, model: diameter })
}

/// Where the scan contradicts its viewpoint: a share of it that cannot be seen from there.
pub(super) fn of_viewpoint(eye: &Point3<f64>, scan: &super::scan::Prepared) -> Option<Doubt> {
    if let Some(normals) = &scan.whole_normals {
        let share = sides::facing_away(&scan.whole, normals, eye);
        if share > MAX_AWAY {
            return Some(Doubt::NormalsAway { share });
        }
    }
    let share = sides::hidden(&scan.whole, eye, scan.voxel);
    (share > MAX_HIDDEN).then_some(Doubt::Hidden { share })
}

/// The factors by which a model would fit what stands out of a scan, if it does not as it is.
pub(super) fn of_units(diameter: f64, standing: &[Body]) -> Option<Doubt> {
    let mut bodies: Vec<&Body> = standing.iter().filter(|body| body.num_cells >= FEW_CELLS).collect();
    bodies.sort_by(|a, b| a.across.total_cmp(&b.across).then(a.num_cells.cmp(&b.num_cells)));
    // The median by cells: what most of the surface belongs to.
    let num_cells: usize = bodies.iter().map(|body| body.num_cells).sum();
    let mut seen = 0;
    let body = bodies.into_iter().find(|body| {
        seen += body.num_cells;
        2 * seen >= num_cells
    })?;
    let ratio = body.across / diameter;
    if RATIOS.contains(&ratio) {
        return None;
    }
    let all = FACTORS.into_iter().chain(FACTORS.map(f64::recip));
    let mut factors: Vec<f64> = all.filter(|factor| RATIOS.contains(&(ratio / factor))).collect();
    factors.sort_by(|a, b| (ratio / a).ln().abs().total_cmp(&(ratio / b).ln().abs()));
    (!factors.is_empty()).then_some(Doubt::OtherUnit { body: body.across, diameter, factors })
}

/// So many digits, as people read them: `%.{digits}g` of C.
pub(super) fn general(value: f64, digits: u32) -> String {
    let short = |text: &str| {
        let zeros = if text.contains('.') { &['0'][..] } else { &[] };
        text.trim_end_matches(zeros).trim_end_matches('.').to_owned()
    };
    let rounded = format!("{value:.*e}", digits as usize - 1);
    // No exponent: infinite, or no number.
    let Some((mantissa, exponent)) = rounded.split_once('e') else { return rounded };
    let exponent: i32 = exponent.parse().unwrap_or(0);
    let decimals = digits.cast_signed() - 1 - exponent;
    if exponent >= -4 && decimals >= 0 {
        return short(&format!("{value:.*}", decimals as usize));
    }
    let sign = if exponent < 0 { '-' } else { '+' };
    format!("{}e{sign}{:02}", short(mantissa), exponent.abs())
}

#[cfg(test)]
mod tests {
    use super::general;

    #[test]
    fn numbers_are_written_as_by_c() {
        let written = [
            (0.0, "0"),
            (0.7, "0.7"),
            (1.0, "1"),
            (3.741_657, "3.74"),
            (99.96, "100"),
            (123.4, "123"),
            (999.6, "1e+03"),
            (22_000.0, "2.2e+04"),
            (0.000_123_45, "0.000123"),
            (0.000_012_345, "1.23e-05"),
            (-0.05, "-0.05"),
            (f64::INFINITY, "inf"),
        ];
        for (value, text) in written {
            assert_eq!(general(value, 3), text);
        }
        assert_eq!(general((1.0_f64 / 25.4).recip(), 6), "25.4");
    }
}
