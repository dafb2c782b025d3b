//! Small scenes with their expected results, as files that Rust and Python read alike: `tests/golden/*.json` at
//! the root of the repository.
//!
//! A file holds the input (`params` may be partial; `src`, `tgt`, `corr`), the `truth` (4x4 row-major, meant to
//! be found) and what this version finds (`expected`). After a change that is meant to alter results, write the
//! files anew and look at the difference:
//!
//! ```text
//! IBI_BLESS=1 cargo test -p ibi-core --all-features --test all golden
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::PathBuf;

use ibi_core::nalgebra::{Isometry3, Matrix4, Point3};
use ibi_core::{Cloud, Correspondences, Params, Registrar, Registration, Shortcuts};
use ibi_testkit::scenes::{Recipe, Scene};
use serde_json::{Value, json};

/// The paper's stages, sharper than in the paper: 80 clean points are sparse. The parameters are written out in
/// full where they matter, so that new defaults do not change the files.
fn paper(n_vot: u32) -> Value {
    json!({
        "delta_r_pr": 10.0,
        "t_he_pr": 1.0,
        "d_op_pr": 0.5,
        "min_normal_cos": null,
        "t_s": 5,
        "scs": { "variant": "gtm", "n_downsample": 1024, "n_gtm": 20, "payoff": "gaussian" },
        "ce": { "variant": "voting", "n_vot": n_vot },
        "te": { "variant": "gsac", "n_gsac": 100, "min_height_pr": 2.0 },
        "hv": { "variant": "overlap", "t_overlap": 0.85, "exclusive": false },
        "refine": "none",
        "n_contest": 1,
        "joint_check": false,
        "removal": "dense",
        "max_rejections": null
    })
}

/// What `Params::default()` was when the file was written.
fn evidence() -> Value {
    json!({
        "delta_r_pr": 1.0,
        "t_he_pr": 1.5,
        "d_op_pr": 1.5,
        "t_s": 4,
        "scs": { "variant": "local_gtm", "tau_pr": 1.0, "min_length_pr": 1.0, "second_order": true, "n_gtm": 20 },
        "ce": { "variant": "voting", "n_vot": 300 },
        "te": { "variant": "irls", "n_refits": 4 },
        "hv": { "variant": "evidence", "t_score": 0.5, "exclusive": true },
        "refine": "icp",
        "n_contest": 60,
        "joint_check": true,
        "removal": "inliers",
        "max_rejections": 60
    })
}

/// `base` with the entries of `other` in the place of its own.
fn with(mut base: Value, other: Value) -> Value {
    let Value::Object(other) = other else { panic!("not an object") };
    base.as_object_mut().unwrap().extend(other);
    base
}

fn cases() -> Vec<(Scene, Value)> {
    let small =
        Recipe { num_points: 80, true_pairs: 70, num_clutter: 40, jitter: 0.005, ..Recipe::default() };
    let recipe = |name, seed, num_instances, num_outliers| {
        Recipe { name, seed, num_instances, num_outliers, ..small }.build()
    };
    let nothing = Recipe { name: "no_instance", true_pairs: 0, num_outliers: 200, seed: 14, ..small };
    vec![
        (recipe("two_instances", 11, 2, 100), paper(70)),
        (recipe("four_instances", 12, 4, 100), paper(70)),
        (recipe("offset_1e5", 13, 3, 120).offset(1e5), paper(70)),
        (recipe("millimetres", 15, 3, 120).scaled(1000.0), paper(70)),
        (recipe("evidence", 17, 3, 200), evidence()),
        // Its instances are there, but no correspondence says so.
        (Scene { truth: Vec::new(), ..nothing.build() }, paper(70)),
        (
            recipe("ratio_ransac_inlier_count", 16, 2, 100),
            with(
                paper(70),
                json!({
                    "seed": 7,
                    "scs": { "variant": "gtm", "payoff": "ratio" },
                    "te": { "variant": "ransac", "n_ransac": 300 },
                    "hv": { "variant": "inlier_count", "t_inliers": 40 }
                }),
            ),
        ),
    ]
}

fn folder() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden"))
}

fn rows_of(matrix: &Matrix4<f64>) -> Value {
    json!(matrix.row_iter().map(|row| row.iter().copied().collect::<Vec<_>>()).collect::<Vec<_>>())
}

fn points_of(points: &[Point3<f64>]) -> Value {
    let round = |x: f64| (x * 1e5).round() / 1e5;
    json!(points.iter().map(|p| p.coords.map(round).as_slice().to_vec()).collect::<Vec<_>>())
}

/// What Python's `labels` hold: -1 for none.
fn labels_of(result: &Registration) -> Vec<i64> {
    result.labels.iter().map(|label| label.map_or(-1, i64::from)).collect()
}

fn expected_of(result: &Registration) -> Value {
    json!({
        "poses": result.poses.iter().map(|p| rows_of(&p.target_from_source.to_homogeneous())).collect::<Vec<_>>(),
        "scores": result.poses.iter().map(|pose| pose.score).collect::<Vec<_>>(),
        "labels": labels_of(result),
        "stop_reason": serde_json::to_value(result.stop_reason).unwrap()["name"],
        "num_rounds": result.rounds.len(),
    })
}

fn read<T: serde::de::DeserializeOwned>(file: &Value, key: &str) -> T {
    serde_json::from_value(file[key].clone()).unwrap_or_else(|e| panic!("{key}: {e}"))
}

fn register(file: &Value) -> Registration {
    register_by(file, Shortcuts::default(), 2)
}

fn register_by(file: &Value, shortcuts: Shortcuts, num_threads: usize) -> Registration {
    let cloud = |key| Cloud::from(read::<Vec<[f64; 3]>>(file, key));
    Registrar::new(&cloud("src"))
        .unwrap()
        .params(read::<Params>(file, "params"))
        .shortcuts(shortcuts)
        .num_threads(num_threads)
        .register(&cloud("tgt"), &Correspondences::from_rows(read(file, "corr")))
        .unwrap()
}

/// One key a line, so that a difference can be read.
fn write_file(scene: &Scene, params: &Value) {
    let mut file = json!({
        "name": scene.name,
        "params": params,
        "src": points_of(&scene.source),
        "tgt": points_of(&scene.target),
        "corr": scene.rows,
        "truth": scene.truth.iter().map(|pose| rows_of(&pose.to_homogeneous())).collect::<Vec<_>>(),
    });
    file["expected"] = expected_of(&register(&file));
    let mut text = String::from("{");
    for (i, key) in ["name", "params", "src", "tgt", "corr", "truth", "expected"].iter().enumerate() {
        let comma = if i == 0 { "" } else { "," };
        write!(text, "{comma}\n\"{key}\": {}", file[key]).unwrap();
    }
    text += "\n}\n";
    assert!(text.len() < 60_000, "{} is too large", scene.name);
    std::fs::write(folder().join(scene.name).with_extension("json"), text).unwrap();
}

fn is_close(a: &Matrix4<f64>, b: &Matrix4<f64>, relative: f64) -> bool {
    a.iter().zip(b.iter()).all(|(a, b)| (a - b).abs() <= relative * b.abs().max(1.0))
}

fn matrices(file: &Value, key: &str) -> Vec<Matrix4<f64>> {
    let rows: Vec<[[f64; 4]; 4]> = read(file, key);
    rows.into_iter().map(|rows| Matrix4::from(rows).transpose()).collect()
}

fn check_file(file: &Value) {
    let name = &file["name"];
    let result = register(file);
    let expected = &file["expected"];
    let (poses, now) = (matrices(expected, "poses"), expected_of(&result));
    assert_eq!(now["stop_reason"], expected["stop_reason"], "{name}");
    assert_eq!(now["num_rounds"], expected["num_rounds"], "{name}");
    assert_eq!(now["labels"], expected["labels"], "{name}");
    assert_eq!(result.poses.len(), poses.len(), "{name}");
    for (pose, expected) in result.poses.iter().zip(&poses) {
        assert!(is_close(&pose.target_from_source.to_homogeneous(), expected, 1e-6), "{name}");
    }
    let scores: Vec<f64> = read(expected, "scores");
    assert!(
        result.poses.iter().zip(&scores).all(|(pose, score)| (pose.score - score).abs() < 1e-6),
        "{name}"
    );
    // Right, and not only the same: every instance is found, where its points go, and nothing else is.
    let truth = matrices(file, "truth");
    let source: Vec<[f64; 3]> = read(file, "src");
    let near = |a: &Matrix4<f64>, b: &Isometry3<f64>| {
        let gap = |p: &[f64; 3]| (a.transform_point(&Point3::from(*p)) - b * Point3::from(*p)).norm();
        source.iter().map(gap).fold(0.0, f64::max) < result.resolution
    };
    let found: Vec<_> = result.poses.iter().map(|pose| pose.target_from_source).collect();
    assert!(truth.iter().all(|t| found.iter().any(|f| near(t, f))), "{name}: an instance is missing");
    assert!(found.iter().all(|f| truth.iter().any(|t| near(t, f))), "{name}: a pose is wrong");
}

/// The golden files, by their names.
fn files() -> BTreeMap<String, Value> {
    let paths = std::fs::read_dir(folder()).unwrap().map(|entry| entry.unwrap().path());
    let paths = paths.filter(|path| path.extension().is_some_and(|extension| extension == "json"));
    let read = |path: PathBuf| {
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        (name, serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap())
    };
    paths.map(read).collect()
}

#[test]
fn results_are_those_of_the_files() {
    if std::env::var_os("IBI_BLESS").is_some_and(|value| value == "1") {
        std::fs::create_dir_all(folder()).unwrap();
        for (scene, params) in cases() {
            write_file(&scene, &params);
        }
    }
    let files = files();
    for (name, file) in &files {
        check_file(file);
        assert_eq!(file["name"], *name);
    }
    let expected: BTreeSet<&str> = cases().iter().map(|(scene, _)| scene.name).collect();
    assert_eq!(files.keys().map(String::as_str).collect::<BTreeSet<_>>(), expected);
}

#[test]
fn without_shortcuts_the_same_poses_are_found() {
    let all = Shortcuts::default();
    let fewer = [
        Shortcuts { glance: false, ..all },
        Shortcuts { memory: false, ..all },
        Shortcuts { ahead: false, ..all },
        Shortcuts::NONE,
    ];
    for (name, file) in files() {
        let usual = register(&file);
        let bits = |result: &Registration| {
            let poses: Vec<_> =
                result.poses.iter().map(|pose| (pose.target_from_source, pose.score)).collect();
            (poses, result.labels.clone(), result.rounds.clone())
        };
        // Looking ahead guesses, and a wrong guess costs time only; on one thread there is none.
        for num_threads in [1, 2, 7] {
            for ahead in [false, true] {
                let result = register_by(&file, Shortcuts { ahead, ..all }, num_threads);
                assert!(bits(&result) == bits(&usual), "{name}: {num_threads} threads, ahead {ahead}");
            }
        }
        for shortcuts in fewer {
            let plain = register_by(&file, shortcuts, 2);
            assert_eq!(plain.poses.len(), usual.poses.len(), "{name}: {shortcuts:?}");
            for (a, b) in plain.poses.iter().zip(&usual.poses) {
                let apart = a.target_from_source.to_homogeneous() - b.target_from_source.to_homogeneous();
                assert!(apart.amax() < 0.1 * usual.resolution, "{name}: {shortcuts:?}: {apart}");
                assert!((a.score - b.score).abs() < 0.01, "{name}: {shortcuts:?}");
            }
        }
    }
}
