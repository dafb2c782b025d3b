//! Models of several kinds, looked for together.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use nalgebra::Point3;

use super::detect::{Detect, Detection, MatchedScan};
use super::model::Model;
use super::rivals::{Rival, outdone};
use super::shared::{Shared, Told};
use super::{DetectionError, Doubt};
use crate::evidence::Measures;
use crate::evidence::explained::{Reach, Shape, explained};
use crate::evidence::seen::Tolerance;
use crate::kernels::par::{self, Pool};
use crate::params::Params;
use crate::registrar::{Observer, Registrar};
use crate::registration::{Pose, Registration, Round};
use crate::scene::Cloud;
use crate::stop::StopReason;

/// Models that are looked for together, each with a name; threads may share them.
///
/// # Examples
/// ```
/// use std::sync::Arc;
///
/// use ibi_core::detection::{Detect, FromMesh, Model, Models};
/// use ibi_core::{Cloud, nalgebra::{Point3, Vector3}};
///
/// let faces = [
///     [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
///     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
/// ];
/// let cuboid = |[x, y, z]: [f64; 3]| {
///     let corner = |i: u8| Point3::new(f64::from(i / 4) * x, f64::from(i / 2 % 2) * y, f64::from(i % 2) * z);
///     Model::from_mesh(&(0..8).map(corner).collect::<Vec<_>>(), &faces, &FromMesh::default())
/// };
/// let (brick, slab) = (Arc::new(cuboid([3.0, 2.0, 1.0])?), Arc::new(cuboid([4.0, 2.5, 0.5])?));
/// let models = Models::new(vec![("brick".into(), brick.clone()), ("slab".into(), slab.clone())])?;
///
/// // A scene that shows each once, from all sides.
/// let mut points = brick.points().to_vec();
/// points.extend(slab.points().iter().map(|p| p + Vector3::new(9.0, 0.0, 0.0)));
/// let normals = [brick.normals().unwrap_or_default(), slab.normals().unwrap_or_default()].concat();
/// let found = models.detect(&Cloud::from(points).with_normals(normals), &Detect::default())?;
/// assert_eq!(found.parts.iter().map(|part| part.registration.poses.len()).collect::<Vec<_>>(), [1, 1]);
/// # Ok::<(), ibi_core::detection::DetectionError>(())
/// ```
#[derive(Debug, Clone)]
pub struct Models {
    parts: Vec<(String, Arc<Model>)>,
}

/// The instances of several models in a scan.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Detections {
    /// Of each model what was found of it. A pose that better poses of other models outdo is among the rejected ones.
    pub parts: Vec<Detection>,
    /// [index of the model, index of its pose] of all poses, best score first; of equals the lesser index.
    pub ranking: Vec<[usize; 2]>,
    /// Why the whole ended: what ended it from outside, or the reason of the last model.
    pub stop_reason: StopReason,
    /// Seconds of wall time of the whole.
    pub total_s: f64,
}

impl Detections {
    /// What the result is to be mistrusted for, and the index of the model that it is about.
    pub fn doubts(&self) -> impl Iterator<Item = (usize, &Doubt)> {
        self.parts.iter().enumerate().flat_map(|(at, part)| part.doubts().map(move |doubt| (at, doubt)))
    }
}

impl Models {
    /// Models and their names.
    ///
    /// # Errors
    /// If there is none, or two are of one name.
    pub fn new(parts: Vec<(String, Arc<Model>)>) -> Result<Self, DetectionError> {
        if parts.is_empty() {
            return Err(DetectionError::NoModels);
        }
        let mut known = BTreeMap::new();
        for (second, (name, _)) in parts.iter().enumerate() {
            if let Some(first) = known.insert(name.clone(), second) {
                return Err(DetectionError::SameName { name: name.clone(), first, second });
            }
        }
        Ok(Self { parts })
    }

    /// In the order in which they were given.
    #[must_use]
    pub fn names(&self) -> impl ExactSizeIterator<Item = &str> {
        self.parts.iter().map(|(name, _)| name.as_str())
    }

    /// In the order in which they were given.
    #[must_use]
    pub fn models(&self) -> impl ExactSizeIterator<Item = &Arc<Model>> {
        self.parts.iter().map(|(_, model)| model)
    }

    /// Finds every instance of every model in a scan: each is searched as by [`Model::detect`], one after the other, and then all poses
    /// compete for what was measured.
    ///
    /// The scan is prepared once for all models of the same [`Model::voxel`]. The better of two poses is the one of the larger
    /// score times the number of measured points that it explains; one of whose points more than a third are explained by better poses of
    /// other models is rejected, as [`crate::Objection::Outdone`]. `max_instances` is of each model, and
    /// `timeout_s` of all together: a model may take an equal share of what is left when its turn comes.
    ///
    /// # Errors
    /// Those of [`Model::detect`], of any model.
    pub fn detect(&self, scan: &Cloud<'_>, options: &Detect) -> Result<Detections, DetectionError> {
        self.detect_with(scan, options, |_, registrar, _| registrar, &mut ())
    }

    /// [`Self::detect`] with stages of your own, which `set_up` puts in for the model of that index, and an observer that sees every
    /// round; if it ends a run, no further model is looked for.
    ///
    /// # Errors
    /// Those of [`Self::detect`].
    pub fn detect_with(
        &self,
        scan: &Cloud<'_>,
        options: &Detect,
        mut set_up: impl FnMut(usize, Registrar<'static>, &MatchedScan) -> Registrar<'static>,
        observer: &mut dyn Observer,
    ) -> Result<Detections, DetectionError> {
        let start = Instant::now();
        let params = options.params_for(scan)?;
        self.models().try_for_each(|model| model.check().map(|_| ()))?;
        let interrupt = options.run.interrupt().with_timeout(start, params.timeout_s);
        let pool = Pool::new(options.run.num_threads)?;
        let told = || {
            let none = Told { voxel: f64::INFINITY, diameter: 0.0, faces: Vec::new() };
            self.models().try_fold(none, |all, model| {
                let Told { voxel, diameter, faces } = model.told(&interrupt)?;
                Ok(Told {
                    voxel: all.voxel.min(voxel),
                    diameter: all.diameter.max(diameter),
                    faces: [all.faces, faces].concat(),
                })
            })
        };
        let mut shared = match pool
            .install(|| Shared::new(scan, options.wanted(params.oriented_normals), told, &interrupt))
        {
            Ok(shared) => Some(shared),
            Err(error) if error.is_interrupted() => None,
            Err(error) => return Err(error),
        };
        drop(pool);
        let mut is_ended = false;
        let mut parts: Vec<Detection> = Vec::with_capacity(self.parts.len());
        for (at, model) in self.models().enumerate() {
            let begin = Instant::now();
            let spent_s = start.elapsed().as_secs_f64();
            let share = |limit: f64| (limit - spent_s).max(0.0) / (self.parts.len() - at) as f64;
            let own = Params { timeout_s: params.timeout_s.map(share), ..params.clone() };
            let mut part = if is_ended {
                let reason = StopReason::Cancelled;
                let registration = Registration::empty(0, reason, begin, model.source().spacing);
                Detection::without_scan(registration, own)
            } else if let Some(shared) = &mut shared {
                let mut until = |round: &Round| {
                    let flow = observer.on_round(round);
                    is_ended = flow.is_break();
                    flow
                };
                model.search(
                    shared,
                    options,
                    own,
                    begin,
                    |registrar, scan| set_up(at, registrar, scan),
                    &mut until,
                )?
            } else {
                model.no_time(own, begin, &interrupt)
            };
            part.params.timeout_s = params.timeout_s;
            parts.push(part);
        }
        if let Some(shared) = shared.filter(|_| self.parts.len() > 1) {
            let pool = Pool::new(options.run.num_threads)?;
            pool.install(|| self.compete(&shared, &mut parts));
        }
        let mut ranking: Vec<[usize; 2]> = Vec::new();
        for (at, part) in parts.iter().enumerate() {
            ranking.extend((0..part.registration.poses.len()).map(|pose| [at, pose]));
        }
        let score = |of: &[usize; 2]| parts[of[0]].registration.poses[of[1]].score;
        ranking.sort_by(|a, b| score(b).total_cmp(&score(a)));
        let total_s = start.elapsed().as_secs_f64();
        let reasons = || parts.iter().map(|part| part.registration.stop_reason);
        let stop_reason = match reasons().find(StopReason::is_from_outside).or(reasons().next_back()) {
            Some(StopReason::Timeout { threshold, .. }) => {
                StopReason::Timeout { value: total_s, threshold: params.timeout_s.unwrap_or(threshold) }
            }
            Some(reason) => reason,
            None => StopReason::Cancelled,
        };
        Ok(Detections { parts, ranking, stop_reason, total_s })
    }

    /// Drops what is outdone.
    fn compete(&self, shared: &Shared<'_>, parts: &mut [Detection]) {
        let points = &shared.searched.points;
        // Enough to tell a half.
        let scan: Vec<Point3<f64>> = points.iter().copied().step_by(1 + points.len() / MANY_POINTS).collect();
        let eyes = &shared.viewpoints;
        let poses: Vec<(usize, &Pose)> = (0..)
            .zip(&*parts)
            .flat_map(|(at, part)| part.registration.poses.iter().map(move |p| (at, p)))
            .collect();
        let rows = par::map(poses.len(), 1, |i| {
            let (at, pose) = poses[i];
            let model = &self.parts[at].1;
            let voxel = parts[at].scan.as_ref().map_or(model.voxel(), |scan| scan.voxel);
            let across = match pose.measures {
                Some(Measures { noise, .. }) => Tolerance::of(voxel, noise * voxel).across,
                None => voxel,
            };
            let shape = Shape { points: model.points(), normals: model.normals().unwrap_or_default() };
            let reach = Reach { across, aside: voxel };
            explained(shape, &pose.target_from_source, eyes, &scan, reach)
        });
        let rivals = poses.iter().zip(&rows);
        let rivals: Vec<Rival<'_>> =
            rivals.map(|(&(part, pose), rows)| Rival { part, score: pose.score, rows }).collect();
        let mut is_outdone = outdone(&rivals, scan.len()).into_iter();
        for part in parts {
            let num = part.registration.poses.len();
            let dropped: Vec<bool> = is_outdone.by_ref().take(num).collect();
            part.registration.drop_outdone(&dropped);
        }
    }
}

/// Points that poses compete for at most; of more every second is taken, or fewer.
const MANY_POINTS: usize = 500_000;
