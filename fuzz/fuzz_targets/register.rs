//! A registration of anything: a typed error or a sound result, the same on any number of threads.
#![no_main]

use arbitrary::{Result, Unstructured};
use ibi_core::nalgebra::{Matrix3, Point3};
use ibi_core::{Cloud, Correspondences, Params, Registrar, Registration, StopReason};
use ibi_fuzz::{bits, check, finite, motion, normals, number, params, points, rows, tame};
use libfuzzer_sys::fuzz_target;

/// Seconds, then a run ends by itself: parameters may ask for days.
const TIMEOUT_S: f64 = 0.5;

struct Case {
    source: Cloud<'static>,
    target: Cloud<'static>,
    correspondences: Correspondences,
    params: Params,
    len: usize,
}

fn case(u: &mut Unstructured<'_>) -> Result<Option<Case>> {
    let Some(mut params) = params(u)? else { return Ok(None) };
    params.timeout_s = Some(TIMEOUT_S);
    let src = points(u, 40)?;
    // Instances of it, and what else stands about.
    let mut tgt = Vec::new();
    let mut pairs = Vec::new();
    for _ in 0..u.int_in_range(0..=3)? {
        let pose = motion(u)?;
        pairs.extend((0..src.len()).map(|i| [i, tgt.len() + i]));
        tgt.extend(src.iter().map(|p| pose * p));
    }
    tgt.extend(points(u, 30)?);
    for _ in 0..u.int_in_range(0..=40)? {
        pairs.push([u.int_in_range(0..=src.len().max(1) - 1)?, u.int_in_range(0..=tgt.len().max(1) - 1)?]);
    }
    if u.ratio(1, 32)? {
        pairs.push([u.arbitrary()?, u.arbitrary()?]);
    }
    let len = pairs.len();
    let mut correspondences = if u.ratio(1, 4)? {
        let at = |all: &[Point3<f64>], i: usize| all.get(i).copied().unwrap_or_default();
        Correspondences::from_points(pairs.iter().map(|&[i, j]| [at(&src, i), at(&tgt, j)]).collect())
    } else {
        Correspondences::from_rows(pairs)
    };
    if u.arbitrary()? {
        let is_wild = u.ratio(1, 16)?;
        let similarity: Result<_> = (0..len).map(|_| if is_wild { number(u) } else { tame(u) }).collect();
        correspondences = correspondences.with_similarity(similarity?);
    }
    let (src_len, tgt_len) = (src.len(), tgt.len());
    let (mut source, mut target) = (Cloud::from(src), Cloud::from(tgt));
    if u.arbitrary()? {
        source = source.with_normals(normals(u, src_len)?);
        target = target.with_normals(normals(u, tgt_len)?);
    }
    if u.ratio(1, 4)? {
        source = source.with_frames(vec![Matrix3::identity(); src_len]);
        target = target.with_frames(vec![Matrix3::identity(); tgt_len]);
    }
    if u.arbitrary()? {
        target = target.with_viewpoint(Point3::new(finite(u)?, finite(u)?, finite(u)?));
        if u.arbitrary()? {
            let measured: Vec<_> = rows(u, 60)?.into_iter().map(Point3::from).collect();
            target = target.with_measured(measured);
        }
    }
    Ok(Some(Case { source, target, correspondences, params, len }))
}

fn run(case: &Case, num_threads: usize) -> Option<Registration> {
    let registrar = Registrar::new(&case.source).ok()?.params(case.params.clone()).num_threads(num_threads);
    registrar.register(&case.target, &case.correspondences).ok()
}

fuzz_target!(|data: &[u8]| {
    let Ok(Some(case)) = case(&mut Unstructured::new(data)) else { return };
    let one = run(&case, 1);
    if let Some(found) = &one {
        check(found, case.len);
    }
    let several = [2, 3, 7][data.len() % 3];
    let other = run(&case, several);
    let is_timeout = |found: &Option<Registration>| matches!(found, Some(f) if matches!(f.stop_reason, StopReason::Timeout { .. }));
    if !is_timeout(&one) && !is_timeout(&other) {
        assert_eq!(one.as_ref().map(bits), other.as_ref().map(bits), "1 thread and {several} differ");
    }
});
