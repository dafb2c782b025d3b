//! Stages of the user's: callables of Python behind the traits of the core.
//!
//! `ibi_rs.stages` stands between: it makes the view that the callable gets, and checks shapes, ids and numbers of what
//! comes back. Whether a matrix is a rigid motion is checked here.

use std::collections::HashMap;
use std::sync::Arc;

use ibi_core::Registrar;
use ibi_core::nalgebra::Isometry3;
use ibi_core::stages::{
    Context, Enhance, Estimate, EstimatePose, Hypothesis, Ranked, SelectSeeds, Validate, Verdict,
};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1};
use pyo3::prelude::*;

use crate::background::Caller;
use crate::convert::{Pose, entries, matrices, pose};

/// A callable in the place of a stage. Where it fails the run is cancelled, and what the stage answers then is thrown
/// away.
struct Own {
    callable: Arc<Py<PyAny>>,
    caller: Caller,
}

/// The callables of the user's, by the names of the stages that they stand for.
pub(crate) type OwnStages = HashMap<String, Py<PyAny>>;

pub(crate) fn put_in<'a>(registrar: Registrar<'a>, own: OwnStages, caller: &Caller) -> Registrar<'a> {
    own.into_iter().fold(registrar, |registrar, (stage, callable)| {
        let own = Own { callable: Arc::new(callable), caller: caller.clone() };
        match stage.as_str() {
            "scs" => registrar.with_scs(own),
            "ce" => registrar.with_ce(own),
            "te" => registrar.with_te(own),
            "hv" => registrar.with_hv(own),
            _ => registrar,
        }
    })
}

/// What the stage before has come to.
enum Given {
    Nothing,
    Ranked(Ranked),
    Pose(Isometry3<f64>),
}

impl Own {
    /// Calls with (round, resolution, alive, barred, poses) and what is given.
    fn ask<T: Send + 'static>(
        &self,
        context: &Context<'_>,
        given: Given,
        read: impl FnOnce(&Bound<'_, PyAny>) -> PyResult<T> + Send + 'static,
    ) -> Option<T> {
        let callable = Arc::clone(&self.callable);
        let (round, resolution) = (context.round, context.scene.resolution);
        let alive: Vec<i64> = context.alive.ids().iter().copied().map(i64::from).collect();
        let barred: Vec<i64> =
            (0_i64..).zip(context.barred).filter(|&(_, &barred)| barred).map(|(id, _)| id).collect();
        let poses: Vec<Isometry3<f64>> = context.claims.poses().copied().collect();
        self.caller.call(move |py| {
            let poses = matrices(py, poses.iter())?;
            let view = (round, resolution, alive.into_pyarray(py), barred.into_pyarray(py), poses);
            let callable = callable.bind(py);
            let answer = match given {
                Given::Nothing => callable.call1((view,)),
                Given::Ranked(ranked) => {
                    let ids = PyArray1::from_iter(py, ranked.ids().iter().copied().map(i64::from));
                    let scores = PyArray1::from_iter(py, ranked.scores().iter().copied().map(f64::from));
                    callable.call1((view, ids, scores))
                }
                Given::Pose(pose) => {
                    let matrix: Bound<'_, PyArray2<f64>> =
                        entries(&pose).collect::<Vec<_>>().into_pyarray(py).reshape([4, 4])?;
                    callable.call1((view, matrix))
                }
            }?;
            read(&answer)
        })
    }
}

impl SelectSeeds for Own {
    fn select_seeds(&self, context: &Context<'_>) -> Ranked {
        self.ask(context, Given::Nothing, ranked).unwrap_or_default()
    }
}

impl Enhance for Own {
    fn enhance(&self, context: &Context<'_>, seeds: &Ranked) -> Ranked {
        self.ask(context, Given::Ranked(seeds.clone()), ranked).unwrap_or_default()
    }
}

impl EstimatePose for Own {
    fn estimate_pose(&self, context: &Context<'_>, dense: &Ranked) -> Estimate {
        let scored = self.ask(context, Given::Ranked(dense.clone()), scored_pose).flatten();
        let hypothesis = scored.map(|(target_from_source, score)| {
            let score = score.unwrap_or_else(|| context.mae(&target_from_source));
            Hypothesis { target_from_source, score }
        });
        let num_degenerate = u32::from(hypothesis.is_none());
        Estimate { hypothesis, num_samples: 1, num_degenerate, capped: false }
    }
}

impl Validate for Own {
    fn validate(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Verdict {
        let read = |answer: &Bound<'_, PyAny>| answer.extract::<(f64, f64)>();
        let measured = self.ask(context, Given::Pose(hypothesis.target_from_source), read);
        let (value, threshold) = measured.unwrap_or_default();
        Verdict { value, threshold }
    }
}

fn ranked(answer: &Bound<'_, PyAny>) -> PyResult<Ranked> {
    let (ids, scores): (PyReadonlyArray1<'_, i64>, PyReadonlyArray1<'_, f32>) = answer.extract()?;
    let ids = ids.as_array();
    Ok(Ranked::new(ids.iter().map(|&id| id as u32).zip(scores.as_array().iter().copied()).collect()))
}

/// The pose and its score, if it has one.
type ScoredPose = Option<(Isometry3<f64>, Option<f64>)>;

/// From None, or from what the pose is called in errors, its matrix, and its score or None.
fn scored_pose(answer: &Bound<'_, PyAny>) -> PyResult<ScoredPose> {
    let answer: Option<(String, Pose<'_>, Option<f64>)> = answer.extract()?;
    answer.map(|(name, matrix, score)| Ok((pose(&name, &matrix)?, score))).transpose()
}
