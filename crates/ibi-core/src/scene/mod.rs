//! The two clouds of a run and what is known of them together: what lies near, resolution, what the camera measured.

mod cloud;
mod clouds;
mod correspondence;
mod tolerances;

use nalgebra::{Isometry3, Point3};

use crate::detail::Detail;
use crate::error::Error;
use crate::interrupt::Interrupt;
use crate::kernels::icp::{Stop, icp};
use crate::kernels::nearby::Nearby;
use crate::kernels::overlap::{Contact, Fit, Place, Surface, chance_fit, fit, overlap, own_fit, places};
use crate::kernels::par;
use crate::kernels::rng::Rng;
use crate::kernels::sight::{Eye, RangeImage, View, spread};

pub use cloud::{Cloud, PreparedCloud};
pub(crate) use cloud::{Measurement, PROBE_POINTS, SCOUT_POINTS, check_points};
pub(crate) use clouds::Clouds;
pub use correspondence::{Alive, Correspondences, PointPairs};
pub use tolerances::Tolerances;

/// Both clouds of a run.
#[derive(Debug)]
pub struct Scene<'a> {
    /// The source (model).
    pub source: &'a PreparedCloud<'a>,
    /// The target (scene).
    pub target: PreparedCloud<'a>,
    /// pr: the mean of the two clouds' spacings, or the value given in the parameters. Data units.
    pub resolution: f64,
    /// When points of the two agree.
    pub tolerances: Tolerances,
    /// The source points within the reach of all questions: 2 `d_op` or `t_he`, whichever is more.
    pub near_source: Nearby,
    /// The target points within the same reach.
    pub near_target: Nearby,
    /// The cameras that saw it; with oriented normals and a viewpoint.
    pub eyes: Vec<Eye>,
}

impl<'a> Scene<'a> {
    pub(crate) fn new(
        clouds: Clouds<'a>,
        [near_source, near_target]: [Nearby; 2],
        measured: &Measurement<'_>,
        tolerances: Tolerances,
        interrupt: &Interrupt,
    ) -> Result<Self, Error> {
        interrupt.proceed()?;
        let Clouds { source, target, resolution } = clouds;
        let mut scene =
            Self { source, target, resolution, tolerances, near_source, near_target, eyes: Vec::new() };
        if scene.is_one_sided() {
            // Now, not first from within a parallel map: both are one themselves.
            scene.source.shade(interrupt);
            interrupt.proceed()?;
            let places = &scene.target.viewpoints;
            let far = |a: usize, b: usize| (places[a] - places[b]).norm_squared();
            let rows = spread(0, MOST_EYES, places.len(), far);
            scene.eyes = par::map(rows.len(), 1, |at| {
                let row = rows[at];
                let (points, normals) = measured.of(row, places.len(), &scene.target);
                let place = places[row];
                let facing = normals.map(|normals| {
                    let facing = points.iter().zip(normals).filter(|(p, n)| n.dot(&(place - *p)) > 0.0);
                    facing.map(|(p, _)| *p).collect::<Vec<_>>()
                });
                let points = facing.as_deref().unwrap_or(points);
                Eye { place, measured: RangeImage::new(place, points, PIXEL_PR * resolution) }
            });
        }
        interrupt.proceed()?;
        Ok(scene)
    }
}

impl Scene<'_> {
    /// Where each source point lies on the target once the pose has moved it, by `d_op` and, if
    /// normals count, by their agreement.
    #[must_use]
    pub fn places(&self, target_from_source: &Isometry3<f64>) -> Vec<Place> {
        let (source, target, contact) = self.surfaces(self.tolerances.d_op_pr);
        places(&source, &target, &self.near_target, target_from_source, &contact)
    }

    /// Share of the source points, of those that a camera can see, that lie on the target once the pose has moved them.
    #[must_use]
    pub fn overlap(&self, target_from_source: &Isometry3<f64>) -> f64 {
        let (source, target, contact) = self.surfaces(self.tolerances.d_op_pr);
        overlap(&source, &target, &self.near_target, target_from_source, &contact)
    }

    /// The fit of the moved source to the target points that are not claimed, within a reach of 2 `d_op`.
    #[must_use]
    pub fn fit(
        &self,
        detail: Detail,
        target_from_source: &Isometry3<f64>,
        are_claimed: impl Fn(&[u32]) -> Vec<bool> + Sync,
    ) -> Fit {
        let (source, target, contact) = self.probed(detail);
        fit(&source, &target, &self.near_target, target_from_source, &contact, are_claimed)
    }

    /// The fit that chance gives a pose somewhere on the target.
    #[must_use]
    pub fn chance_fit(&self, rng: Rng) -> f64 {
        let (source, target, contact) = self.surfaces(2.0 * self.tolerances.d_op_pr);
        chance_fit(&source, &target, &self.near_target, &contact, rng, CHANCE_SAMPLES)
    }

    /// The fit that the noise of the target lets a pose have: 1 unless the scene is seen from one side.
    #[must_use]
    pub fn best_fit(&self, rng: Rng) -> f64 {
        if !self.is_one_sided() {
            return 1.0;
        }
        let (_, target, contact) = self.surfaces(2.0 * self.tolerances.d_op_pr);
        own_fit(&target, &self.near_target, &contact, rng, CHANCE_SAMPLES)
    }

    /// For each of `points` (of the target), given with a key, that lies within `distance_pr` of the moved source: the
    /// key, the row of the nearest source point and the distance in data units. A point within `d_op` is explained by
    /// the pose. `distance_pr` is at most 2 `d_op`.
    pub fn nearest_source<K>(
        &self,
        distance_pr: f64,
        target_from_source: &Isometry3<f64>,
        points: impl IntoIterator<Item = (K, Point3<f64>)>,
    ) -> Vec<(K, u32, f64)> {
        let distance = distance_pr * self.resolution;
        let back = target_from_source.inverse();
        let (rotation, shift) = (back.rotation.to_rotation_matrix(), back.translation.vector);
        // Far points need no search.
        let (centre, radius) = (self.source.centre, self.source.radius + distance);
        let points = points.into_iter();
        let num = points.size_hint().0;
        let (mut keys, mut moved) = (Vec::with_capacity(num), Vec::with_capacity(num));
        for (key, point) in points {
            let point = rotation * point + shift;
            if (point - centre).norm_squared() <= radius * radius {
                keys.push(key);
                moved.push(point);
            }
        }
        let nearest = self.near_source.nearest_each(distance, &moved);
        let found = keys.into_iter().zip(&moved).zip(nearest).filter_map(|((key, moved), row)| {
            let row = row?;
            let gap = (moved - self.source.points[row as usize]).norm();
            (gap <= distance).then_some((key, row, gap))
        });
        found.collect()
    }

    /// The pose polished on the two clouds by ICP within 2 `d_op`: on few points for a first glance, which brings a
    /// poor pose most of the way at a quarter of the cost, or on more.
    #[must_use]
    pub fn icp(&self, detail: Detail, target_from_source: &Isometry3<f64>) -> Isometry3<f64> {
        let (source, target, contact) = self.probed(detail);
        let stop = match detail {
            Detail::Glance => Stop { max_visible: 2 * SCOUT_POINTS, ..Stop::new(10, 0.02) },
            // Point-to-plane may come from far, and comes to rest; point-to-point creeps on.
            Detail::Look => {
                let steps = if target.normals.is_some() { 20 } else { 12 };
                Stop { max_visible: PROBE_POINTS, ..Stop::new(steps, 0.003) }
            }
        };
        icp(&source, &target, &self.near_target, target_from_source, &contact, stop)
    }

    /// Whether source points that a camera cannot see are left out.
    pub(crate) fn is_one_sided(&self) -> bool {
        let Tolerances { min_normal_cos, oriented_normals, .. } = self.tolerances;
        let with_normals = min_normal_cos.is_some() && self.source.normals.is_some();
        with_normals && oriented_normals && !self.target.viewpoints.is_empty()
    }

    /// A few source points against the target within a reach of 2 `d_op`; more if they are seen from one side: then few
    /// of them can be seen.
    fn probed(&self, detail: Detail) -> (Surface<'_>, Surface<'_>, Contact<'_>) {
        let (all, target, contact) = self.surfaces(2.0 * self.tolerances.d_op_pr);
        let contact = Contact { view: self.view(detail), ..contact };
        let with_normals = self.tolerances.min_normal_cos.is_some();
        let [scout, probe] =
            [&self.source.scout, &self.source.probe].map(|probe| probe.surface(with_normals));
        let source = match (detail, contact.view) {
            (Detail::Glance, None) => scout,
            (Detail::Look, None) | (Detail::Glance, Some(_)) => probe,
            (Detail::Look, Some(_)) => all,
        };
        (source, target, contact)
    }

    fn view(&self, detail: Detail) -> Option<View<'_>> {
        self.is_one_sided().then(|| View { eyes: &self.eyes, own: self.source.own_shadow(detail) })
    }

    fn surfaces(&self, distance_pr: f64) -> (Surface<'_>, Surface<'_>, Contact<'_>) {
        let Tolerances { min_normal_cos, oriented_normals, .. } = self.tolerances;
        let with_normals = min_normal_cos.is_some();
        let contact = Contact {
            distance: distance_pr * self.resolution,
            min_normal_cos: min_normal_cos.unwrap_or(-1.0),
            oriented: oriented_normals,
            view: self.view(Detail::Look),
            to_planes: self.is_one_sided(),
        };
        (self.source.surface(with_normals), self.target.surface(with_normals), contact)
    }
}

/// Of more cameras, so many that stand far from each other stand for all.
const MOST_EYES: usize = 12;

/// Least width of a pixel of what the camera measured: wider than the errors of a pose, narrower than a part.
const PIXEL_PR: f64 = 0.6;

/// Enough to know the fit by chance to a hundredth.
const CHANCE_SAMPLES: usize = 1000;
