//! A scan as it is prepared for one model or several: what they have in common is worked out once.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use nalgebra::Point3;

use super::doubts::{self, Doubt};
use super::error::DetectionError;
use super::model::describe;
use super::roi::Roi;
use super::scan::{Measured, Prepared, Setting};
use crate::error::Argument;
use crate::interrupt::Interrupt;
use crate::scene::{Cloud, check_points};

/// A scan that was checked, and what was made of it at each voxel that a model has asked for.
pub(super) struct Shared<'a> {
    pub(super) scan: &'a Cloud<'a>,
    remove_plane: Option<bool>,
    /// What of the scan is finite.
    pub(super) all: Vec<Point3<f64>>,
    /// What of that is searched: all, or what lies in the region of interest.
    pub(super) searched: Measured,
    /// Of the largest of the models.
    diameter: f64,
    ready: BTreeMap<u64, Ready>,
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
    /// Checks a scan, of which what lies in `roi` is searched. `diameter`: of the largest model.
    pub(super) fn new(
        scan: &'a Cloud<'a>,
        roi: Option<&Roi>,
        remove_plane: Option<bool>,
        diameter: impl FnOnce() -> Result<f64, DetectionError>,
    ) -> Result<Self, DetectionError> {
        if scan.viewpoint.is_none() && scan.normals.is_none() {
            return Err(DetectionError::NoSide);
        }
        if let Some(roi) = roi {
            roi.check()?;
        }
        let measured = Measured::of(&scan.points, scan.normals.as_deref())?;
        check_points(&measured.points, Argument::Tgt)?;
        if scan.normals.is_some() && measured.normals.is_none() {
            let (num_missing, len) = (measured.num_without_normal, measured.points.len());
            return Err(DetectionError::MostNormalsMissing { num_missing, len });
        }
        let diameter = diameter()?;
        let all = measured.points.clone();
        let searched = match roi {
            Some(roi) => measured.within(|point| roi.contains(point)),
            None => measured,
        };
        Ok(Self { scan, remove_plane, all, searched, diameter, ready: BTreeMap::new() })
    }

    /// What it is at the voxel of a model.
    pub(super) fn at(&mut self, voxel: f64, interrupt: &Interrupt) -> Result<&mut Ready, DetectionError> {
        let viewpoint = self.scan.viewpoint;
        match self.ready.entry(voxel.to_bits()) {
            Entry::Occupied(ready) => Ok(ready.into_mut()),
            Entry::Vacant(place) => {
                let setting =
                    Setting { voxel, diameter: self.diameter, viewpoint, remove_plane: self.remove_plane };
                let prepared = Prepared::new(&self.searched, &setting, interrupt)?;
                let doubt = viewpoint.and_then(|eye| {
                    let is_behind = prepared.is_behind_table.then_some(Doubt::BehindPlane);
                    is_behind.or_else(|| doubts::of_viewpoint(&eye, &prepared))
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
