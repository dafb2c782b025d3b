//! Poses at full resolution: polished on all that was measured, and how well they are known.

use nalgebra::{Isometry3, Matrix6, Point3, Vector3, Vector6};

use super::closeup::Closeup;
use super::polish::{Faces, Hold, Measured, Polished, Touch, information, polish, touches, weight};
use super::shared::{Correlation, Off, Pairs, pairs};
use super::slip::{FreeMotion, covariance, free_motions, jacobian, principal_motions};
use crate::kernels::nearby::{Nearby, spacing};
use crate::scene::Scene;

/// The model's surface, and what was measured, eye by eye.
pub(crate) struct Fine {
    points: Vec<Point3<f64>>,
    normals: Vec<Vector3<f64>>,
    nearby: Nearby,
    spacing: f64,
    eyes: Vec<Eye>,
}

struct Eye {
    at: Point3<f64>,
    points: Vec<Point3<f64>>,
    /// Between its rays, radians.
    spacing: f64,
}

/// A pose, and what the planes and ends of its faces tell of it.
#[derive(Debug)]
pub(crate) struct Fitted {
    pub(crate) target_from_source: Isometry3<f64>,
    pub(crate) pairs: Pairs,
    /// Information of the planes where each point has its own error.
    planes: Matrix6<f64>,
    ends: Matrix6<f64>,
    centre: Point3<f64>,
    size: f64,
    tolerance: f64,
}

/// How well a pose is known.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Known {
    pub(crate) covariance: Matrix6<f64>,
    pub(crate) free_motions: Vec<FreeMotion>,
}

/// How far off its plane a point may lie, in tolerances of a close look; farther at first.
const ACROSS: f64 = 1.5;
const FIRST_ACROSS: f64 = 2.0;

/// Cosine between the normal of the thinned scan and the plane that a point is held against.
const SAME_SIDE_COS: f64 = 0.5;

/// Faces that are turned by less against each other are one: those of a round surface that a mesh is of.
const ROUND_COS: f64 = 0.9;
const ROUND_SPACINGS: f64 = 2.0;

/// Standard deviation, voxels, to which a close look settles a motion that moves all ends of faces across themselves. It counts
/// points: of one that moves a part of the ends as much less is seen, and so it is known as much less.
const ENDS_VOXELS: f64 = 0.06;

/// Standard deviation of what a model of samples is off by, at a point as far from the centre as it reaches; voxels.
const MODEL_VOXELS: f64 = 0.005;

/// Fewer ends say nothing.
const FEW_ENDS: usize = 6;

/// A motion is free that is not known to a voxel.
const FREE_VOXELS: f64 = 1.0;

/// How far normals of a round surface that is made of faces may be turned: those of 24 around, blended.
const TILT_RAD: f64 = 0.1;

const FREEDOMS: f64 = 6.0;

impl Fine {
    /// `None` where the model has no normals.
    pub(crate) fn new(closeup: &Closeup, scene: &Scene<'_>) -> Option<Self> {
        let source = scene.source;
        let (points, faces) = match &source.fine {
            Some((points, normals)) => (points.clone(), normals.clone()),
            None => (source.points.to_vec(), source.normals.clone()?),
        };
        let spacing = spacing(&points);
        let reach = (FIRST_ACROSS * ACROSS * closeup.tolerance().across).hypot(2.0 * spacing);
        let nearby = Nearby::new(&points, reach);
        let normals = rounded(&points, &faces, &nearby, ROUND_SPACINGS * spacing);
        let eyes = closeup.rays().iter().map(|rays| Eye {
            at: *rays.eye(),
            points: rays.all(),
            spacing: rays.spacing(),
        });
        Some(Self { eyes: eyes.collect(), points, normals, nearby, spacing })
    }

    /// Points that are looked at for a pose, about.
    pub(crate) fn cost(&self) -> usize {
        self.eyes.iter().map(|eye| eye.points.len()).sum::<usize>() + self.points.len()
    }

    /// A pose polished on the measured points that it explains and none of the `others`; `None` if they are too few.
    pub(crate) fn fit(
        &self,
        closeup: &Closeup,
        scene: &Scene<'_>,
        pose: &Isometry3<f64>,
        others: &[Isometry3<f64>],
    ) -> Option<Fitted> {
        let (centre, size) = (scene.source.centre, scene.source.radius);
        let (voxel, across) = (closeup.voxel(), ACROSS * closeup.tolerance().across);
        let mut measured = Vec::new();
        let mut ends_at = Vec::new();
        for eye in &self.eyes {
            measured.extend(self.own(scene, eye, pose, others, FIRST_ACROSS * across));
            ends_at.push(measured.len());
        }
        let ends = ends_of(closeup, scene, pose);
        let hold =
            Hold { centre, size, information: ends, across, most: voxel, noise: 0.5 * closeup.noise() };
        let polished = polish(&self.faces(), &measured, pose, &hold)?;
        let target_from_source = polished.target_from_source;
        let moved_centre = target_from_source * centre;
        let mut all = Pairs::default();
        let mut from = 0;
        for (eye, to) in self.eyes.iter().zip(ends_at) {
            let off = |(ray, touch): (&Measured, &Option<Touch>)| {
                let Touch { gap, normal } = (*touch)?;
                let ray = Point3::from(-ray.to_eye / eye.spacing);
                Some(Off { ray, normal, gap: weight(gap, polished.cutoff) * gap })
            };
            let offs: Vec<Off> =
                measured[from..to].iter().zip(&polished.touches[from..to]).filter_map(off).collect();
            all = all.and(&pairs(&offs));
            from = to;
        }
        let planes = information(&measured, &polished, &moved_centre);
        // Planes that are turned a little would tell of motions that they do not hold: a rod's turn about its axis.
        let along = |axis: usize| {
            let mut touches = polished.touches.clone();
            touches.iter_mut().flatten().for_each(|touch| touch.normal = Vector3::ith(axis, 1.0));
            information(&measured, &Polished { touches, ..polished.clone() }, &moved_centre)
        };
        let all_ways: Matrix6<f64> = (0..3).map(along).sum();
        let planes = above_zero(&(planes - (all_ways - planes) * TILT_RAD.powi(2)), size);
        let tolerance = FREE_VOXELS * voxel;
        Some(Fitted { target_from_source, pairs: all, planes, ends, centre: moved_centre, size, tolerance })
    }

    fn faces(&self) -> Faces<'_> {
        let Self { points, normals, nearby, spacing, .. } = self;
        Faces { points, normals, nearby, spacing: *spacing }
    }

    /// What an eye measured near a pose and on its side, but for what is nearer to another pose or was taken for background.
    fn own(
        &self,
        scene: &Scene<'_>,
        eye: &Eye,
        pose: &Isometry3<f64>,
        others: &[Isometry3<f64>],
        across: f64,
    ) -> Vec<Measured> {
        let (centre, radius) = (pose * scene.source.centre, scene.source.radius + across);
        let around = eye.points.iter().filter(|p| (*p - centre).norm_squared() <= radius * radius);
        let measured: Vec<Measured> =
            around.map(|&at| Measured { at, to_eye: (eye.at - at).normalize() }).collect();
        let wide = Faces { spacing: 2.0 * self.spacing, ..self.faces() };
        let touches = touches(&wide, &measured, pose, across);
        let (measured, touches): (Vec<Measured>, Vec<Touch>) =
            measured.into_iter().zip(touches).filter_map(|(ray, touch)| Some((ray, touch?))).unzip();
        let places: Vec<Point3<f64>> = measured.iter().map(|ray| ray.at).collect();
        let is_same_side = sides(scene, &places, &touches);
        let own = self.distances(&places, pose);
        let mut is_own = is_same_side;
        for other in others {
            for ((is_own, own), theirs) in is_own.iter_mut().zip(&own).zip(self.distances(&places, other)) {
                *is_own &= *own <= theirs;
            }
        }
        measured.into_iter().zip(is_own).filter_map(|(ray, is_own)| is_own.then_some(ray)).collect()
    }

    /// Of places from the nearest point of the model that a pose has moved; infinite if it is far.
    fn distances(&self, places: &[Point3<f64>], pose: &Isometry3<f64>) -> Vec<f64> {
        let back = pose.inverse();
        let places: Vec<Point3<f64>> = places.iter().map(|place| back * place).collect();
        let nearest = self.nearby.nearest_each(self.nearby.reach(), &places);
        let distance = |(place, row): (&Point3<f64>, Option<u32>)| {
            row.map_or(f64::INFINITY, |row| (place - self.points[row as usize]).norm())
        };
        places.iter().zip(nearest).map(distance).collect()
    }
}

impl Fitted {
    /// With errors that are correlated so.
    pub(crate) fn known(&self, correlation: &Correlation) -> Known {
        let sharing = self.pairs.sharing(correlation);
        // What was fitted has taken a part of what the points lay off.
        let left = (1.0 - FREEDOMS * sharing / self.pairs.num.max(1.0)).max(0.0);
        let information = self.planes * (left / sharing) + self.ends;
        let model = self.tolerance * MODEL_VOXELS / FREE_VOXELS;
        let turn = model / self.size;
        let model =
            Vector6::new(turn, turn, turn, model, model, model).map(|deviation| deviation * deviation);
        Known {
            covariance: covariance(&information, self.size) + Matrix6::from_diagonal(&model),
            free_motions: free_motions(&information, &self.centre, self.size, self.tolerance),
        }
    }
}

/// Whether the thinned scan has a point near each place, turned to the side of what it touches.
fn sides(scene: &Scene<'_>, places: &[Point3<f64>], touches: &[Touch]) -> Vec<bool> {
    let Some(normals) = &scene.target.normals else { return vec![true; places.len()] };
    let reach = scene.near_target.reach().min(2.0 * scene.resolution);
    let nearest = scene.near_target.nearest_each(reach, places);
    let is_same = |(row, touch): (Option<u32>, &Touch)| {
        row.is_some_and(|row| normals[row as usize].dot(&touch.normal) > SAME_SIDE_COS)
    };
    nearest.into_iter().zip(touches).map(is_same).collect()
}

/// The information of the ends of faces that the eyes see past.
fn ends_of(closeup: &Closeup, scene: &Scene<'_>, pose: &Isometry3<f64>) -> Matrix6<f64> {
    let centre = pose * scene.source.centre;
    let ends = closeup.ends(scene, pose);
    if ends.len() < FEW_ENDS {
        return Matrix6::zeros();
    }
    let mut sum = Matrix6::zeros();
    for (at, outwards) in &ends {
        let j = jacobian(at, outwards, &centre);
        sum.syger(1.0, &j, &j, 1.0);
    }
    sum.fill_upper_triangle_with_lower_triangle();
    let size = scene.source.radius;
    // As shares of all ends, turns measured at a size from the centre.
    let unit = Matrix6::from_diagonal(&Vector6::new(size, size, size, 1.0, 1.0, 1.0));
    let share = Matrix6::from_diagonal(&unit.map_diagonal(f64::recip));
    let shares = share * sum * share / ends.len() as f64;
    unit * shares * shares * unit / (ENDS_VOXELS * closeup.voxel()).powi(2)
}

/// The information without what is below zero of it.
fn above_zero(information: &Matrix6<f64>, size: f64) -> Matrix6<f64> {
    principal_motions(information, size)
        .iter()
        .filter(|(_, deviation)| deviation.is_finite())
        .map(|(motion, deviation)| {
            // Of unit length where turns count a size: so its transpose is its inverse.
            let turn = size * size;
            let held = motion.component_mul(&Vector6::new(turn, turn, turn, 1.0, 1.0, 1.0)) / *deviation;
            held * held.transpose()
        })
        .sum()
}

/// Normals of a surface that is round where the faces of a mesh are turned a little against each other.
fn rounded(
    points: &[Point3<f64>],
    faces: &[Vector3<f64>],
    nearby: &Nearby,
    distance: f64,
) -> Vec<Vector3<f64>> {
    let of = |(point, face): (&Point3<f64>, &Vector3<f64>)| {
        let mut rows: Vec<u32> = nearby.within(point, distance).collect();
        rows.sort_unstable();
        let alike = rows.iter().map(|&row| &faces[row as usize]).filter(|other| other.dot(face) > ROUND_COS);
        alike.sum::<Vector3<f64>>().try_normalize(f64::MIN_POSITIVE).unwrap_or(*face)
    };
    points.iter().zip(faces).map(of).collect()
}
