//! The model and a scan: matched, and registered.

use std::time::Instant;

use nalgebra::{Point3, Vector3};

use super::bodies::across;
use super::doubts::{self, Doubt};
use super::model::{DIM, Model};
use super::roi::Roi;
use super::scan::standing;
use super::shared::{Shared, Told, Wanted};
use super::{DetectionError, Origin, Run, VOXELS_PER_SPACING, sides};
use crate::features::{Descriptors, FeatureError, Matches, Matching, match_features, voxel_downsample};
use crate::interrupt::Interrupt;
use crate::kernels::par::Pool;
use crate::params::Params;
use crate::registrar::{Observer, Registrar};
use crate::registration::Registration;
use crate::scene::{Cloud, Correspondences};
use crate::stop::StopReason;

/// A scan of more cameras is one that was walked around.
const FEW_VIEWPOINTS: usize = 4;

/// Nearest model points that each scene point is joined to: walls and edges repeat on a part.
const PER_POINT: usize = 4;

/// In larger voxels a part is a few points, which fit everywhere; below the second number that is told.
const MIN_VOXELS_PER_DIAMETER: f64 = 8.0;
const FEW_VOXELS_PER_DIAMETER: f64 = 12.0;

/// Points that a pose needs.
const MIN_POINTS: usize = 3;

/// How a model is looked for in a scan.
#[derive(Debug, Clone)]
pub struct Detect {
    /// `timeout_s` counts from the call. `None`: [`Params::single_view`] with one to four viewpoints, else
    /// [`Params::many_views`].
    pub params: Option<Params>,
    /// Whether the plane with most points is taken away. `None`: where it looks like a table, with less than 2 % of the
    /// points behind it as the viewpoint sees it. Flat faces that are half as long or wide again as any of the model are taken away
    /// unless this is `Some(false)`: walls, other parts.
    pub remove_plane: Option<bool>,
    /// Whether a scan is refused that is 10 times smaller than the model or 300 times larger. What counts is the box around
    /// all points but the outermost hundredth on each side; fewer than 100 points tell nothing.
    pub check_units: bool,
    /// What of the scan is looked into; `None`: all of it.
    pub roi: Option<Roi>,
    /// What the same camera measured without the parts, an empty bin: what lies within a voxel of it (of the finest model) is not searched, nor
    /// matched, but it stays in what was measured. Points that are not finite are none.
    pub background: Option<Vec<Point3<f64>>>,
    /// Threads, and how to end it.
    pub run: Run,
}

impl Default for Detect {
    fn default() -> Self {
        Self {
            params: None,
            remove_plane: None,
            check_units: true,
            roi: None,
            background: None,
            run: Run::default(),
        }
    }
}

impl Detect {
    pub(super) fn wanted(&self, is_sided: bool) -> Wanted<'_> {
        let background = self.background.as_deref();
        Wanted { roi: self.roi.as_ref(), background, remove_plane: self.remove_plane, is_sided }
    }

    /// Those that were given, or those that fit the scan; checked.
    pub(super) fn params_for(&self, scan: &Cloud<'_>) -> Result<Params, DetectionError> {
        let is_few = (1..=FEW_VIEWPOINTS).contains(&scan.viewpoints.len());
        let preset = || if is_few { Params::single_view() } else { Params::many_views() };
        let params = self.params.clone().unwrap_or_else(preset);
        params.validate()?;
        Ok(params)
    }
}

/// A scan as it was matched with a model.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct MatchedScan {
    /// The scan, thinned and without its table and walls.
    pub points: Vec<Point3<f64>>,
    /// One for each of them, of length 1.
    pub normals: Vec<Vector3<f64>>,
    /// [row of the model, row of `points`], and how alike they are.
    pub matches: Matches,
    /// What of the thinned scan was taken away: its table and walls, and what lies on the background that was given.
    pub background: Vec<Point3<f64>>,
    /// What the scan was thinned to, data units: the model's voxel, or more where the scan is coarser.
    pub voxel: f64,
    /// What is doubtful about the scan, and about the model.
    pub doubts: Vec<Doubt>,
}

/// The instances of a model in a scan.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Detection {
    /// The poses. Labels and inliers are rows of the matches of [`Self::scan`].
    pub registration: Registration,
    /// What was registered; `None` where time ran out before.
    pub scan: Option<MatchedScan>,
    /// Those of the run: with a resolution that the scan can carry, where it is coarser than the model.
    pub params: Params,
    /// Of what nothing was found, and in which unit there would be something.
    of_units: Option<Doubt>,
}

impl Detection {
    pub(super) fn without_scan(registration: Registration, params: Params) -> Self {
        Self { registration, scan: None, params, of_units: None }
    }

    /// What the result is to be mistrusted for.
    pub fn doubts(&self) -> impl Iterator<Item = &Doubt> {
        self.scan.iter().flat_map(|scan| &scan.doubts).chain(&self.of_units)
    }
}

impl Model {
    /// Finds every instance of this model in a scan: [`Self::correspond`], then a [`Registrar`].
    ///
    /// Wanted are the viewpoint of the scan or its normals, which then point outwards; and all that was measured
    /// ([`Cloud::with_measured`]) where the scan is only a part of it. A scan that holds nothing, and one for which there was
    /// no time, gives an empty result.
    ///
    /// # Errors
    /// If the model has no normals; if neither a viewpoint nor normals are given, or most of them are missing; if the scan
    /// cannot be in the unit of the model; if a parameter is out of range; else those of [`Registrar::begin`].
    pub fn detect(&self, scan: &Cloud<'_>, options: &Detect) -> Result<Detection, DetectionError> {
        self.detect_with(scan, options, |registrar, _| registrar, &mut ())
    }

    /// [`Self::detect`] with stages of your own, which `set_up` puts in, and an observer that sees every round.
    ///
    /// # Errors
    /// Those of [`Self::detect`].
    pub fn detect_with(
        &self,
        scan: &Cloud<'_>,
        options: &Detect,
        set_up: impl FnOnce(Registrar<'static>, &MatchedScan) -> Registrar<'static>,
        observer: &mut dyn Observer,
    ) -> Result<Detection, DetectionError> {
        let start = Instant::now();
        let params = options.params_for(scan)?;
        self.check()?;
        let interrupt = options.run.interrupt().with_timeout(start, params.timeout_s);
        let pool = Pool::new(options.run.num_threads)?;
        let wanted = options.wanted(params.oriented_normals);
        let shared = pool.install(|| Shared::new(scan, wanted, || self.told(&interrupt), &interrupt));
        drop(pool);
        match shared {
            Ok(mut shared) => self.search(&mut shared, options, params, start, set_up, observer),
            Err(error) if error.is_interrupted() => Ok(self.no_time(params, start, &interrupt)),
            Err(error) => Err(error),
        }
    }

    /// The same, in a scan that other models are looked for in as well. The time that `params` allow counts from `start`.
    pub(super) fn search(
        &self,
        shared: &mut Shared<'_>,
        options: &Detect,
        mut params: Params,
        start: Instant,
        set_up: impl FnOnce(Registrar<'static>, &MatchedScan) -> Registrar<'static>,
        observer: &mut dyn Observer,
    ) -> Result<Detection, DetectionError> {
        let interrupt = options.run.interrupt().with_timeout(start, params.timeout_s);
        // The registrar has a pool of its own, which takes the threads of this one over.
        let pool = || Pool::new(options.run.num_threads);
        let matched = pool()?.install(|| self.matched(shared, options.check_units, &interrupt));
        let matched = match matched {
            Ok(matched) => matched,
            Err(error) if error.is_interrupted() => return Ok(self.no_time(params, start, &interrupt)),
            Err(error) => return Err(error),
        };
        if matched.voxel > self.voxel() && params.resolution.is_none() {
            params.resolution = Some(matched.voxel / VOXELS_PER_SPACING);
        }
        let registration = if interrupt.is_set() || matched.matches.rows.is_empty() {
            self.nothing(&params, start, &interrupt)
        } else {
            let spent_s = start.elapsed().as_secs_f64();
            let timeout_s = params.timeout_s.map(|limit| (limit - spent_s).max(0.0));
            let limited = Params { timeout_s, ..params.clone() };
            let registrar = options.run.registrar(Registrar::of(self.source().clone()).params(limited));
            let (target, correspondences) = matched.input(shared);
            let registrar = set_up(registrar, &matched);
            let mut found = registrar.register_observed(&target, &correspondences, observer)?;
            if let StopReason::Timeout { value, threshold } = &mut found.stop_reason {
                *value = found.timings.total_s + spent_s;
                *threshold = params.timeout_s.unwrap_or(*threshold);
            }
            found
        };
        let is_over = registration.stop_reason.is_from_outside();
        let searched = &shared.searched.points;
        let of_units = if registration.poses.is_empty() && searched.len() >= doubts::ENOUGH && !is_over {
            pool()?.install(|| self.unit_doubt(shared.middle_of_viewpoints(), searched, &interrupt))?
        } else {
            None
        };
        Ok(Detection { registration, scan: Some(matched), params, of_units })
    }

    /// Matches a scan with this model, which needs normals: the first half of [`Self::detect`], on the threads that it is
    /// called on.
    ///
    /// The scan is thinned to [`Self::voxel`], or to what it can carry if it is coarser, its table and walls taken away, its normals
    /// estimated; both clouds are described by FPFH over 6 voxels, and each scene point is joined to the four model points
    /// most like it. Nothing is matched where the scan holds nothing but a table or stray points.
    ///
    /// # Errors
    /// Those of [`Self::detect`]; or if it is interrupted.
    pub fn correspond(
        &self,
        scan: &Cloud<'_>,
        options: &Detect,
        interrupt: &Interrupt,
    ) -> Result<MatchedScan, DetectionError> {
        self.check()?;
        let mut shared = Shared::new(scan, options.wanted(false), || self.told(interrupt), interrupt)?;
        self.matched(&mut shared, options.check_units, interrupt)
    }

    /// What a scan has to know of it.
    pub(super) fn told(&self, interrupt: &Interrupt) -> Result<Told, DetectionError> {
        let (diameter, faces) = (self.diameter(interrupt)?, self.faces(interrupt)?.to_vec());
        Ok(Told { voxel: self.voxel(), diameter, faces })
    }

    /// Whether it can be detected.
    pub(super) fn check(&self) -> Result<&[Vector3<f64>], DetectionError> {
        self.normals().ok_or(DetectionError::NoNormals)
    }

    fn matched(
        &self,
        shared: &mut Shared<'_>,
        check_units: bool,
        interrupt: &Interrupt,
    ) -> Result<MatchedScan, DetectionError> {
        let normals = self.check()?;
        let diameter = self.diameter(interrupt)?;
        if check_units {
            doubts::check_units(diameter, &shared.all)?;
        }
        let (num_dropped, num_in_roi) = (shared.searched.num_dropped, shared.num_in_roi);
        let (num_points, num_given) = (shared.all.len(), shared.scan.points.len());
        let ready = shared.at(self.voxel(), interrupt)?;
        let (voxel, num_left) = (ready.prepared.voxel, ready.prepared.points.len());
        let holds_nothing = num_left < MIN_POINTS || across(&ready.prepared.points) <= self.source().spacing;
        let is_known = voxel <= self.voxel().max(diameter / MIN_VOXELS_PER_DIAMETER);

        let matches = if holds_nothing || !is_known {
            Matches::default()
        } else {
            let described = self.described(normals, voxel, interrupt)?;
            let of_scan = ready.described(interrupt)?;
            let [model, scan] = [&described.values, of_scan].map(|values| Descriptors { values, dim: DIM });
            let matching = Matching { k: PER_POINT, ..Matching::default() };
            let mut matches = match_features(model, scan, matching, interrupt)?;
            if let Some(rows) = &described.rows {
                matches.rows.iter_mut().for_each(|pair| pair[0] = rows[pair[0] as usize]);
            }
            matches
        };

        let mut doubts = Vec::new();
        if num_dropped > 0 {
            doubts.push(Doubt::NotFinite { num_dropped, num_given });
        }
        if num_points < MIN_POINTS {
            doubts.push(Doubt::FewPoints { num_points });
        } else if num_in_roi < MIN_POINTS {
            doubts.push(Doubt::FewInRoi { num_points: num_in_roi, num_given: num_points });
        } else if holds_nothing {
            doubts.push(Doubt::Nothing);
        } else if !is_known {
            doubts.push(Doubt::TooCoarse { voxel, diameter });
        } else if voxel > self.voxel() {
            if let Origin::Mesh { voxel: given, is_given: true } = self.origin() {
                doubts.push(Doubt::CoarserThanGiven { given, voxel });
            }
            if voxel * FEW_VOXELS_PER_DIAMETER > diameter {
                doubts.push(Doubt::Coarse { voxel, diameter });
            }
        }
        doubts.extend(ready.doubt.clone());
        let (points, of_points) = (ready.prepared.points.clone(), ready.prepared.normals.clone());
        let mut background = ready.prepared.taken_away.clone();
        background.extend(voxel_downsample(&shared.on_background, None, voxel, interrupt)?.points);
        doubts.extend(self.normals_doubt(normals, interrupt)?);
        Ok(MatchedScan { points, normals: of_points, matches, background, voxel, doubts })
    }

    /// Whether the normals of a cloud point inwards; those of a mesh were turned.
    fn normals_doubt(
        &self,
        normals: &[Vector3<f64>],
        interrupt: &Interrupt,
    ) -> Result<Option<Doubt>, DetectionError> {
        if self.origin() != Origin::Cloud {
            return Ok(None);
        }
        let share = if let Some(&known) = self.inward.get() {
            known
        } else {
            let share = sides::inward(self.points(), normals, self.source().spacing, interrupt);
            let share = share.ok_or(FeatureError::Interrupted)?;
            *self.inward.get_or_init(|| share)
        };
        Ok((share > doubts::MAX_INWARD).then_some(Doubt::NormalsInward { share }))
    }

    /// Whether another unit would explain that nothing is found; not told once time has run out.
    fn unit_doubt(
        &self,
        viewpoint: Option<Point3<f64>>,
        measured: &[Point3<f64>],
        interrupt: &Interrupt,
    ) -> Result<Option<Doubt>, DetectionError> {
        let told = || {
            let diameter = self.diameter(interrupt)?;
            Ok(doubts::of_units(diameter, &standing(measured, viewpoint, interrupt)?))
        };
        told().or_else(|error: DetectionError| if error.is_interrupted() { Ok(None) } else { Err(error) })
    }

    /// What a scan gives for which there was no time.
    pub(super) fn no_time(&self, params: Params, start: Instant, interrupt: &Interrupt) -> Detection {
        Detection::without_scan(self.nothing(&params, start, interrupt), params)
    }

    /// What a scan gives that holds nothing to register, or for which there was no time.
    fn nothing(&self, params: &Params, start: Instant, interrupt: &Interrupt) -> Registration {
        let few = StopReason::FewCorrespondences { value: 0, threshold: MIN_POINTS as u32 };
        let reason = interrupt.check().break_value().unwrap_or(few);
        Registration::empty(0, reason, start, params.resolution.unwrap_or(self.source().spacing))
    }
}

impl MatchedScan {
    /// What a registrar takes of a scan.
    fn input<'a>(&'a self, scan: &'a Shared<'_>) -> (Cloud<'a>, Correspondences) {
        let mut target = Cloud::new(&self.points).with_normals(self.normals.clone());
        if !scan.viewpoints.is_empty() {
            target = target.with_viewpoints(scan.viewpoints.clone());
            target.measured = scan.measurement();
        }
        let rows = self.matches.rows.iter().map(|pair| pair.map(|row| row as usize)).collect();
        (target, Correspondences::from_rows(rows).with_similarity(self.matches.similarity.clone()))
    }
}
