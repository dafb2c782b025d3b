//! Clouds with normals, and cameras that see them.

use ibi_core::kernels::overlap::Surface;
use ibi_core::kernels::sight::{Eye, View};
use ibi_core::nalgebra::{Isometry3, Point3, Vector3};
use ibi_testkit::naive;
use ibi_testkit::scenes::asymmetric_model;
use ibi_testkit::strategies::{point, rigid_motions};
use proptest::prelude::*;

/// What a camera sees of which nothing is known but its place.
pub(crate) fn seen_from(place: Point3<f64>) -> View<'static> {
    View { eyes: Vec::leak(vec![Eye::at(place)]), own: None }
}

/// A cloud with normals.
#[derive(Debug, Clone, Default)]
pub(crate) struct Oriented {
    pub(crate) points: Vec<Point3<f64>>,
    pub(crate) normals: Vec<Vector3<f64>>,
}

impl Oriented {
    pub(crate) fn model(num_points: usize) -> Self {
        let points = asymmetric_model(num_points);
        Self { normals: naive::outward_normals(&points), points }
    }

    pub(crate) fn moved(&self, pose: &Isometry3<f64>) -> Self {
        Self {
            points: self.points.iter().map(|p| pose * p).collect(),
            normals: self.normals.iter().map(|n| pose * n).collect(),
        }
    }

    pub(crate) fn surface(&self, with_normals: bool) -> Surface<'_> {
        Surface { points: &self.points, normals: with_normals.then_some(&self.normals) }
    }
}

/// Clouds with normals that have nothing to do with the points.
pub(crate) fn clouds(count: std::ops::Range<usize>) -> impl Strategy<Value = Oriented> {
    prop::collection::vec((point(), rigid_motions(1.0)), count).prop_map(|rows| {
        let (points, normals) = rows.into_iter().map(|(p, turn)| (p, turn * Vector3::z())).unzip();
        Oriented { points, normals }
    })
}
