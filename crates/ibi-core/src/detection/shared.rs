//! A scan as it is prepared for one model or several: what they have in common is worked out once.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use nalgebra::{Point3, Vector3};

use super::doubts::{self, Doubt};
use super::error::DetectionError;
use super::model::describe;
use super::roi::Roi;
use super::scan::{Measured, Prepared, Setting};
use super::standpoints::standpoints;
use super::twins::distinct;
use crate::error::Argument;
use crate::interrupt::Interrupt;
use crate::scene::{Cloud, Measurement, check_points};

/// A scan that was checked, and what was made of it at each voxel that a model has asked for.
pub(super) struct Shared<'a> {
    pub(super) scan: &'a Cloud<'a>,
    remove_plane: Option<bool>,
    /// From where it was seen; from where it may have been, if that counts and is not known.
    pub(super) viewpoints: Vec<Point3<f64>>,
    /// What of the scan is finite.
    pub(super) all: Vec<Point3<f64>>,
    /// If normals were given.
    normals_of_all: Option<Vec<Vector3<f64>>>,
    /// What of that is searched: all, or what lies in the region of interest and not on the background.
    pub(super) searched: Measured,
    pub(super) num_in_roi: usize,
    pub(super) on_background: Vec<Point3<f64>>,
    /// Of the largest of the models.
    diameter: f64,
    faces: Vec<[f64; 2]>,
    ready: BTreeMap<u64, Ready>,
}

/// What is wanted of a scan.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wanted<'a> {
    /// What lies in it is searched.
    pub(super) roi: Option<&'a Roi>,
    /// What lies on it is not.
    pub(super) background: Option<&'a [Point3<f64>]>,
    pub(super) remove_plane: Option<bool>,
    /// Whether it counts which side of a surface was seen.
    pub(super) is_sided: bool,
}

/// What a scan has to know of the models.
pub(super) struct Told {
    /// The least of them, data units.
    pub(super) voxel: f64,
    /// Of the largest.
    pub(super) diameter: f64,
    /// How long and how wide their faces are.
    pub(super) faces: Vec<[f64; 2]>,
}

/// A scan at a voxel.
pub(super) struct Ready {
    pub(super) prepared: Prepared,
    /// Whether it contradicts its viewpoint.
    pub(super) doubt: Option<Doubt>,
    /// Once asked for.
    described: Option<Vec<f32>>,
}

impl<'a> Shared<'a> {
    /// Checks a scan.
    pub(super) fn new(
        scan: &'a Cloud<'a>,
        Wanted { roi, background, remove_plane, is_sided }: Wanted<'_>,
        models: impl FnOnce() -> Result<Told, DetectionError>,
        interrupt: &Interrupt,
    ) -> Result<Self, DetectionError> {
        if scan.viewpoints.is_empty() && scan.normals.is_none() {
            return Err(DetectionError::NoSide);
        }
        if let Some(roi) = roi {
            roi.check()?;
        }
        let measured = Measured::of(&scan.points, scan.normals.as_deref())?.distinct();
        // Many a camera writes its own place where it has measured nothing.
        let measured = measured.within(|point| !scan.viewpoints.contains(point));
        check_points(&measured.points, Argument::Tgt)?;
        if scan.normals.is_some() && measured.normals.is_none() {
            let (num_missing, len) = (measured.num_without_normal, measured.points.len());
            return Err(DetectionError::MostNormalsMissing { num_missing, len });
        }
        let background: Option<Vec<_>> = background.map(|points| {
            points.iter().copied().filter(|point| point.iter().all(|x| x.is_finite())).collect()
        });
        if background.as_ref().is_some_and(Vec::is_empty) {
            return Err(DetectionError::NoBackground);
        }
        let Told { voxel, diameter, faces } = models()?;
        let viewpoints = match &measured.normals {
            Some(normals) if scan.viewpoints.is_empty() && is_sided => {
                standpoints(&measured.points, normals, diameter)
            }
            _ => scan.viewpoints.clone(),
        };
        let all = measured.points.clone();
        let normals_of_all = measured.normals.clone();
        let in_roi = match roi {
            Some(roi) => measured.within(|point| roi.contains(point)),
            None => measured,
        };
        let num_in_roi = in_roi.points.len();
        let (searched, on_background) = match background {
            Some(background) => in_roi.off(&background, voxel, interrupt)?,
            None => (in_roi, Vec::new()),
        };
        Ok(Self {
            scan,
            remove_plane,
            viewpoints,
            all,
            normals_of_all,
            searched,
            num_in_roi,
            on_background,
            diameter,
            faces,
            ready: BTreeMap::new(),
        })
    }

    /// About where it was seen from.
    pub(super) fn middle_of_viewpoints(&self) -> Option<Point3<f64>> {
        let sum: Vector3<f64> = self.viewpoints.iter().map(|eye| eye.coords).sum();
        (!self.viewpoints.is_empty()).then(|| Point3::from(sum / self.viewpoints.len() as f64))
    }

    /// All that the cameras measured: as it was given, or all of the scan.
    pub(super) fn measurement(&self) -> Measurement<'_> {
        match &self.scan.measured.parts[..] {
            [] => Measurement { parts: vec![self.all[..].into()], normals: self.normals_of_all.clone() },
            parts => {
                let once = |part: &Cow<'a, [Point3<f64>]>| {
                    let rows = distinct(part);
                    rows.map_or_else(|| part.clone(), |rows| rows.into_iter().map(|row| part[row]).collect())
                };
                Measurement { parts: parts.iter().map(once).collect(), ..self.scan.measured.clone() }
            }
        }
    }

    /// What it is at the voxel of a model.
    pub(super) fn at(&mut self, voxel: f64, interrupt: &Interrupt) -> Result<&mut Ready, DetectionError> {
        let viewpoint = self.middle_of_viewpoints();
        match self.ready.entry(voxel.to_bits()) {
            Entry::Occupied(ready) => Ok(ready.into_mut()),
            Entry::Vacant(place) => {
                let setting = Setting {
                    voxel,
                    diameter: self.diameter,
                    viewpoint,
                    remove_plane: self.remove_plane,
                    faces: &self.faces,
                };
                let mut prepared = Prepared::new(&self.searched, &setting, interrupt)?;
                let given = &self.scan.viewpoints;
                if given.len() > 1 && self.scan.normals.is_none() {
                    prepared.turn_to_eyes(given, &self.scan.measured.parts);
                }
                let is_behind = (prepared.is_behind_table && !given.is_empty()).then_some(Doubt::BehindPlane);
                let doubt = is_behind.or_else(|| match given[..] {
                    [eye] => doubts::of_viewpoint(&eye, &prepared),
                    _ => None,
                });
                Ok(place.insert(Ready { prepared, doubt, described: None }))
            }
        }
    }
}

impl Ready {
    /// Its descriptors.
    pub(super) fn described(&mut self, interrupt: &Interrupt) -> Result<&[f32], DetectionError> {
        let Prepared { points, normals, voxel, .. } = &self.prepared;
        if self.described.is_none() {
            self.described = Some(describe(points, normals, *voxel, interrupt)?);
        }
        Ok(self.described.as_deref().unwrap_or_default())
    }
}
