//! Looking at a pose close up, on all that was measured: it is settled, and held against every ray.

use nalgebra::{Isometry3, Matrix6, Point3, Vector3};

use super::contour::{Contour, Placed, Rim, Scan, contour, overrun, run_on};
use super::noise::{noise_of_rays, sharpness_of_edges, spacing_of_rays};
use super::odds::{Measures, is_blurred};
use super::rays::{Rays, visible};
use super::seen::{Look, Seen, Tally, Tolerance, look, merge, sight};
use super::settle::{Steps, settle};
use super::slip::{information, losses, moved, principal_motions, worth};
use crate::detail::Detail;
use crate::interrupt::Interrupt;
use crate::kernels::nearby::spacing_until;
use crate::kernels::par;
use crate::kernels::sight::{FEW_EYES, asked};
use crate::scene::{Measurement, Scene};

/// What one eye or several have measured in all, and where the source's faces end.
#[derive(Debug)]
pub(crate) struct Closeup {
    rays: Vec<Rays>,
    /// Whether points stand for what several eyes measured together.
    is_fused: bool,
    rim: Rim,
    voxel: f64,
    noise: f64,
    blur: f64,
    edges: Option<f64>,
    tolerance: Tolerance,
}

/// What a close look has found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Proof {
    /// The pose, settled.
    pub(crate) target_from_source: Isometry3<f64>,
    pub(crate) measures: Measures,
    /// Share of the source that is supported.
    pub(crate) explained: f64,
}

impl Proof {
    /// The same in such company, see [`company`](super::odds::company).
    pub(crate) fn among(self, company: f64) -> Self {
        Self { measures: self.measures.among(company), ..self }
    }

    /// The same of a pose that was found.
    pub(crate) fn found_among(self, company: f64) -> Self {
        Self { measures: self.measures.found_among(company), ..self }
    }
}

/// Across a part: a detail is as wide as a voxel is, as a rule.
const DETAILS: f64 = 24.0;

/// A cloud that was thinned to a voxel has its points so many of them apart, about.
const VOXELS_PER_SPACING: f64 = 1.25;

/// How far a face is followed beyond its end, at least, voxels and tolerances; and how far the surface must have fallen away there,
/// tolerances.
const RIM_VOXELS: f64 = 1.5;
const RIM_TOLERANCES: f64 = 2.0;
const FALLEN_TOLERANCES: f64 = 1.3;

/// Steps of the last polish, voxels; and how far it moves the surface across itself at a time, tolerances.
const FIRST_STEP: f64 = 1.0;
const LEAST_STEP: f64 = 0.12;
const ACROSS: f64 = 0.5;
const ROUNDS: u32 = 6;

/// To settle a pose, one in so many points of the source is looked at.
const SETTLED_BY: usize = 2;

/// A pose that so few points support has nothing to be settled by.
const FEW_SUPPORTED: usize = 6;

/// How far a pose is moved to see what it loses, tolerances: 1.5 voxels of a scan without noise.
const SLIP_STEP: f64 = 3.75;

/// The source where a pose puts it, and how each point is seen.
struct At {
    points: Vec<Point3<f64>>,
    normals: Vec<Vector3<f64>>,
    sight: Vec<Look>,
}

impl Closeup {
    /// Of what was `measured` from the viewpoints of a scene with oriented normals. `None` for others, where the noise of a scan that was
    /// not fused blurs what is to be told apart, or if interrupted.
    pub(crate) fn new(scene: &Scene<'_>, measured: &Measurement<'_>, interrupt: &Interrupt) -> Option<Self> {
        let normals = scene.source.normals.as_ref().filter(|_| scene.is_one_sided())?;
        let places = &scene.target.viewpoints;
        let (all, of_all) = measured.of(0, places.len(), &scene.target);
        // What several have measured together is known no better than its points lie apart.
        let spacing = match of_all {
            Some(_) => spacing_until(all, || interrupt.is_set())?,
            None => 0.0,
        };
        let of_eye = |at: usize| {
            let place = scene.eyes[at].place;
            let row = places.iter().position(|of_any| *of_any == place)?;
            let (points, normals) = measured.of(row, places.len(), &scene.target);
            let Some(normals) = normals else { return Rays::new(place, points) };
            let seen = visible(&place, points, normals, spacing);
            Rays::new(place, &seen.into_iter().map(|row| points[row as usize]).collect::<Vec<_>>())
        };
        let rays = par::map(scene.eyes.len(), 1, |at| (!interrupt.is_set()).then(|| of_eye(at)).flatten());
        let rays: Vec<Rays> = rays.into_iter().flatten().collect();
        if rays.is_empty() || interrupt.is_set() {
            return None;
        }
        let voxel = VOXELS_PER_SPACING * scene.resolution;
        // Of what the target is: a table that was taken away may be smoother than the parts, or rougher.
        let noise = noise_of_rays(&rays[0], &scene.target.points);
        // Against the part, whose voxel may have been chosen.
        let detail = scene.source.extent / DETAILS;
        let blur = noise * spacing_of_rays(&rays[0], &scene.target.points, voxel) / detail.powi(2);
        let edges = sharpness_of_edges(&rays[0], &scene.target.points, &scene.near_target, voxel);
        if is_blurred(blur, edges) && of_all.is_none() {
            return None;
        }
        let tolerance = Tolerance::of(voxel, noise);
        let tolerance = Tolerance { aside: tolerance.aside.max(spacing), ..tolerance };
        let reach = (RIM_VOXELS * voxel).max(RIM_TOLERANCES * tolerance.across);
        let rim = Rim::new(&scene.source.points, normals, reach, FALLEN_TOLERANCES * tolerance.across);
        Some(Self { rays, is_fused: of_all.is_some(), rim, voxel, noise, blur, edges, tolerance })
    }

    /// A pose settled, and what was measured of it.
    pub(crate) fn look(&self, scene: &Scene<'_>, target_from_source: &Isometry3<f64>) -> Proof {
        let Self { voxel, tolerance, .. } = *self;
        let size = scene.source.radius;
        let across = ACROSS * tolerance.across;
        let steps = Steps { first: FIRST_STEP * voxel, least: LEAST_STEP * voxel, across, rounds: ROUNDS };
        let motions = |pose: &Isometry3<f64>| {
            let at = self.at(scene, pose, SETTLED_BY);
            let information = information_of(scene, pose, &at);
            information.map_or_else(Vec::new, |(information, count)| {
                let principal = principal_motions(&(information / count as f64), size);
                principal.map(|(motion, deviation)| (motion, deviation.recip())).to_vec()
            })
        };
        let shifted = |pose: &Isometry3<f64>, motion: &_| moved(motion, &(pose * scene.source.centre), pose);
        let (pose, value) =
            settle(target_from_source, steps, motions, shifted, |pose| self.worth(scene, pose));
        self.measured(scene, &pose, value)
    }

    /// What is measured of a settled pose of a `worth`.
    fn measured(&self, scene: &Scene<'_>, pose: &Isometry3<f64>, worth: f64) -> Proof {
        let Self { voxel, tolerance, noise, .. } = *self;
        let source = scene.source;
        let (at, centre) = (self.at(scene, pose, 1), pose * source.centre);
        let placed = at.placed(pose);
        let scan = Self::scan(scene);
        let overrun = scan.map_or_else(Default::default, |scan| {
            let ball = (&source.centre, source.radius);
            overrun(&scene.near_source, ball, scan, placed, tolerance.across, voxel)
        });
        let mut losses_of = [0.0; 3];
        if let Some((information, count)) = information_of(scene, pose, &at) {
            let motions = principal_motions(&(information / count as f64), source.radius);
            let ball = (&centre, source.radius);
            let worth_of = |pose: &Isometry3<f64>| self.worth(scene, pose);
            losses_of = losses(pose, &motions, ball, SLIP_STEP * tolerance.across, worth, worth_of);
        }
        let tally = Tally::of(&at.sight);
        Proof {
            target_from_source: *pose,
            explained: f64::from(tally.supported) / source.points.len() as f64,
            measures: Measures {
                tally,
                contour: self.contour(scene, placed),
                overrun,
                losses: losses_of,
                noise: noise / voxel,
                blur: self.blur,
                edges: self.edges,
                is_fused: self.is_fused,
                ..Measures::default()
            },
        }
    }

    /// What a pose is worth, see [`worth`].
    fn worth(&self, scene: &Scene<'_>, pose: &Isometry3<f64>) -> f64 {
        let at = self.at(scene, pose, SETTLED_BY);
        let rays = self.asked(scene, pose);
        let run_on = run_on(&self.rim, &rays, at.placed(pose), self.tolerance);
        let is_asked = |row: &&u32| at.sight[**row as usize].seen != Seen::Away;
        let num_ends = self.rim.rows.iter().filter(is_asked).count() as u32;
        worth(&at.sight, run_on, num_ends, self.tolerance.across)
    }

    fn contour(&self, scene: &Scene<'_>, placed: Placed<'_>) -> Contour {
        let rays = self.asked(scene, placed.target_from_source);
        Self::scan(scene).map_or_else(Contour::default, |scan| {
            contour(&self.rim, scan, &rays, placed, self.tolerance, self.voxel)
        })
    }

    /// Of the eyes that know most of what lies around a pose.
    fn asked(&self, scene: &Scene<'_>, pose: &Isometry3<f64>) -> Vec<&Rays> {
        asked(&self.rays, Rays::eye, &(pose * scene.source.centre), FEW_EYES)
    }

    fn scan<'s>(scene: &'s Scene<'_>) -> Option<Scan<'s>> {
        let normals = scene.target.normals.as_deref()?;
        Some(Scan { points: &scene.target.points, normals, nearby: &scene.near_target })
    }

    /// Where a pose puts the source; one in `every` of its points is looked at.
    fn at(&self, scene: &Scene<'_>, pose: &Isometry3<f64>, every: usize) -> At {
        let source = scene.source;
        let rotation = pose.rotation.to_rotation_matrix();
        let points: Vec<_> = source.points.iter().map(|p| rotation * p + pose.translation.vector).collect();
        let normals: Vec<_> = source.normals.iter().flatten().map(|n| rotation * n).collect();
        let mut of_all: Option<Vec<Look>> = None;
        for rays in self.asked(scene, pose) {
            let own = source.own_shadow(Detail::Look);
            let is_hidden = own.map_or(&[][..], |own| own.from(rays.eye(), pose));
            let of_one = sight(rays, &points, &normals, is_hidden, every, self.tolerance);
            match &mut of_all {
                None => of_all = Some(of_one),
                Some(of_all) => merge(of_all, &of_one),
            }
        }
        At { points, normals, sight: of_all.unwrap_or_default() }
    }
}

/// The information of the supported points for a noise of 1, and how many they are; `None` if too few.
fn information_of(scene: &Scene<'_>, pose: &Isometry3<f64>, at: &At) -> Option<(Matrix6<f64>, usize)> {
    let seen = at.points.iter().zip(&at.normals).zip(&at.sight);
    let (points, normals): (Vec<_>, Vec<_>) =
        seen.filter(|(_, look)| look.seen == Seen::Supported).map(|((p, n), _)| (*p, *n)).unzip();
    let count = points.len();
    let centre = pose * scene.source.centre;
    (count >= FEW_SUPPORTED).then(|| (information(&points, &normals, &centre, 1.0), count))
}

impl At {
    fn placed<'a>(&'a self, target_from_source: &'a Isometry3<f64>) -> Placed<'a> {
        Placed { target_from_source, points: &self.points, normals: &self.normals, sight: &self.sight }
    }
}

/// What the last polish asks.
impl Closeup {
    /// Whether it is known what each eye measured: of a fused scan it is not known how far its points err alike.
    pub(crate) fn is_fused(&self) -> bool {
        self.is_fused
    }

    pub(super) fn rays(&self) -> &[Rays] {
        &self.rays
    }

    pub(super) fn voxel(&self) -> f64 {
        self.voxel
    }

    pub(super) fn noise(&self) -> f64 {
        self.noise
    }

    pub(super) fn tolerance(&self) -> Tolerance {
        self.tolerance
    }

    /// Where faces end that were measured, and the eyes see past them: points of the model, moved, and unit vectors across its rim,
    /// outwards.
    pub(super) fn ends(&self, scene: &Scene<'_>, pose: &Isometry3<f64>) -> Vec<(Point3<f64>, Vector3<f64>)> {
        let at = self.at(scene, pose, 1);
        let mut ends = Vec::new();
        for (&row, offset) in self.rim.rows.iter().zip(&self.rim.offsets) {
            let (row, offset) = (row as usize, pose.rotation * offset);
            if at.sight[row].seen != Seen::Supported {
                continue;
            }
            let place = at.points[row] + offset;
            let past = self.rays.iter().map(|rays| look(rays, &place, &at.normals[row], self.tolerance).seen);
            if past.max() == Some(Seen::Contradicted) {
                ends.push((at.points[row], offset.normalize()));
            }
        }
        ends
    }
}
