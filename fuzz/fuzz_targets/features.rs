//! Features, meshes, planes and symmetries of anything: a typed error or numbers in their ranges.
#![no_main]

use std::time::Instant;

use arbitrary::{Result, Unstructured};
use ibi_core::features::{
    Amount, Descriptors, Matching, Mesh, Neighborhood, PlaneSearch, Views, dominant_plane, estimate_normals,
    fpfh, match_features, outer_surface, sample_mesh, voxel_downsample,
};
use ibi_core::nalgebra::Point3;
use ibi_core::{CancelToken, FindSymmetries, Interrupt, find_symmetries};
use ibi_fuzz::{check_rigid, normals, number, points};
use libfuzzer_sys::fuzz_target;

/// Some inputs ask for a hundred million points: that a call goes on for long is no fault, that it is deaf is one.
const TIMEOUT_S: f64 = 1.0;

fn features(u: &mut Unstructured<'_>) -> Result<()> {
    let limit = Interrupt::new(CancelToken::default(), Instant::now(), Some(TIMEOUT_S));
    let points = points(u, 80)?;
    let normals = normals(u, points.len())?;
    let neighborhood = Neighborhood { radius: number(u)?, max_neighbors: u.int_in_range(0..=90)? };
    let eye = if u.arbitrary()? { Some(Point3::new(number(u)?, number(u)?, number(u)?)) } else { None };
    match u.int_in_range(0..=6)? {
        0 => {
            let voxel = number(u)?;
            if let Ok(thinned) = voxel_downsample(&points, Some(&normals), voxel, &limit) {
                assert!(thinned.points.len() <= points.len());
                assert!(thinned.points.iter().all(|p| p.iter().all(|x| x.is_finite())));
            }
        }
        1 => {
            if let Ok(found) = estimate_normals(&points, neighborhood, eye, &limit) {
                assert_eq!(found.len(), points.len());
                assert!(found.iter().all(|n| (n.norm() - 1.0).abs() < 1e-9));
            }
        }
        2 => {
            let keys: Vec<usize> = (0..u.int_in_range(0..=9)?)
                .map(|_| u.int_in_range(0..=points.len()))
                .collect::<Result<_>>()?;
            let keys = u.arbitrary::<bool>()?.then_some(&keys[..]);
            if let Ok(rows) = fpfh(&points, &normals, neighborhood, keys, &limit) {
                assert_eq!(rows.len(), keys.map_or(points.len(), <[usize]>::len));
                assert!(rows.iter().flatten().all(|x| (0.0..=200.1).contains(x)));
            }
        }
        3 => {
            let dim = u.int_in_range(1..=5)?;
            let mut values = || -> Result<Vec<f32>> {
                let len = dim * u.int_in_range(0..=40)?;
                (0..len).map(|_| Ok(number(u)? as f32)).collect()
            };
            let (src, tgt) = (values()?, values()?);
            let max_ratio = if u.arbitrary()? { Some(number(u)?) } else { None };
            let matching = Matching { k: u.int_in_range(0..=9)?, mutual: u.arbitrary()?, max_ratio };
            let [src, tgt] = [&src, &tgt].map(|values| Descriptors { values, dim });
            if let Ok(found) = match_features(src, tgt, matching, &limit) {
                assert_eq!(found.rows.len(), found.similarity.len());
                assert!(found.similarity.iter().all(|s| (0.0..=1.0).contains(s)));
            }
        }
        4 => {
            let search = PlaneSearch { distance: number(u)?, min_share: number(u)?, seed: u.arbitrary()? };
            if let Ok(Some(plane)) = dominant_plane(&points, &search, eye, &limit) {
                assert!((plane.normal.norm() - 1.0).abs() < 1e-9);
                assert!((0.0..=1.0).contains(&plane.behind));
            }
        }
        5 => {
            let corner = |u: &mut Unstructured<'_>| u.int_in_range(0..=points.len());
            let faces: Vec<[usize; 3]> = (0..u.int_in_range(0..=40)?)
                .map(|_| Ok([corner(u)?, corner(u)?, corner(u)?]))
                .collect::<Result<_>>()?;
            let mesh = Mesh { vertices: &points, faces: &faces };
            let amount = if u.arbitrary()? {
                Amount::Count(u.int_in_range(0..=500)?)
            } else {
                // So many at most: the number follows from an area of any size.
                Amount::Spacing(number(u)?.abs().max(0.05))
            };
            if let Ok(sampled) = sample_mesh(&mesh, amount, u.arbitrary()?, &limit)
                && sampled.points.len() < 2000
            {
                let views = Views::default();
                let _ = outer_surface(&sampled.points, &sampled.normals, &mesh, &views, &limit);
            }
        }
        _ => {
            let options = FindSymmetries { tolerance: number(u)? };
            if let Ok(found) = find_symmetries(&points, Some(&normals), options, &limit) {
                found.discrete().iter().for_each(check_rigid);
            }
        }
    }
    Ok(())
}

fuzz_target!(|data: &[u8]| {
    let _ = features(&mut Unstructured::new(data));
});
