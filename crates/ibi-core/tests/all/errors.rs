//! Bad input: the exact error and its one line. Unusual but legal input: a good result.

use ibi_core::kernels::compatibility::Payoff;
use ibi_core::nalgebra::{Point3, Vector3};
use ibi_core::stages::ce::Voting;
use ibi_core::stages::hv::{Evidence, InlierCount, Overlap};
use ibi_core::stages::scs::{Gtm, Hough3d, Nnsr};
use ibi_core::stages::te::{Gsac, Mac, Ransac, SacCot};
use ibi_core::{Argument, Cloud, Correspondences, Error, Params, Registrar, Registration, StopReason};
use ibi_testkit::scenes::{Recipe, Scene};

/// All that a user hands in.
struct Input {
    source: Cloud<'static>,
    target: Cloud<'static>,
    correspondences: Correspondences,
    params: Params,
}

impl Input {
    fn of(scene: &Scene) -> Self {
        Self {
            source: Cloud::from(scene.source.clone()),
            target: Cloud::from(scene.target.clone()),
            correspondences: Correspondences::from_rows(scene.rows.clone()),
            // Not `Params::default()`, which may change.
            params: Params { t_he_pr: 3.0, ce: Voting { n_vot: 60 }.into(), ..Params::paper_synthetic() },
        }
    }

    fn good() -> Self {
        Self::of(&easy())
    }

    fn register(&self) -> Result<Registration, Error> {
        Registrar::new(&self.source)?
            .params(self.params.clone())
            .num_threads(1)
            .register(&self.target, &self.correspondences)
    }
}

fn easy() -> Scene {
    Recipe { true_pairs: 80, ..Recipe::default() }.build()
}

/// `register` must fail with this error and this message.
fn assert_fails(input: &Input, error: &Error, message: &str) {
    let got = input.register().expect_err(message);
    // Not `==`: NaN in an error equals nothing.
    assert_eq!(format!("{got:?}"), format!("{error:?}"));
    assert_eq!(got.to_string(), message);
    assert!(!message.contains('\n'));
}

fn with_source(change: impl FnOnce(&mut Vec<Point3<f64>>)) -> Input {
    let mut points = easy().source;
    change(&mut points);
    Input { source: Cloud::from(points), ..Input::good() }
}

fn with_target(change: impl FnOnce(&mut Vec<Point3<f64>>)) -> Input {
    let mut points = easy().target;
    change(&mut points);
    Input { target: Cloud::from(points), ..Input::good() }
}

fn not_finite(argument: Argument, row: usize, value: [f64; 3]) -> Error {
    Error::NotFinite { argument, row, value }
}

#[test]
fn coordinates_must_be_finite() {
    let allowed = "; coordinates must be finite and below 1e100";
    for (bad, word) in [(f64::NAN, "NaN"), (f64::INFINITY, "inf"), (f64::NEG_INFINITY, "-inf")] {
        assert_fails(
            &with_source(|points| points[3] = Point3::new(0.0, bad, 2.0)),
            &not_finite(Argument::Src, 3, [0.0, bad, 2.0]),
            &format!("src[3] is [0, {word}, 2]{allowed}"),
        );
        assert_fails(
            &with_target(|points| points[249] = Point3::new(bad, 0.0, 0.5)),
            &not_finite(Argument::Tgt, 249, [bad, 0.0, 0.5]),
            &format!("tgt[249] is [{word}, 0, 0.5]{allowed}"),
        );
        let points =
            vec![[Point3::origin(), Point3::origin()], [Point3::origin(), Point3::new(1.0, 2.0, bad)]];
        assert_fails(
            &Input { correspondences: Correspondences::from_points(points), ..Input::good() },
            &not_finite(Argument::Corr, 1, [1.0, 2.0, bad]),
            &format!("corr[1] is [1, 2, {word}]{allowed}"),
        );
        assert_fails(
            &Input {
                target: Cloud::from(easy().target).with_viewpoint(Point3::new(0.0, 0.0, bad)),
                ..Input::good()
            },
            &not_finite(Argument::Viewpoint, 0, [0.0, 0.0, bad]),
            &format!("viewpoint[0] is [0, 0, {word}]{allowed}"),
        );
    }
    let input = with_source(|points| points[0].x = 1e200);
    let Err(Error::NotFinite { argument: Argument::Src, row: 0, value: [x, ..] }) = input.register() else {
        panic!("1e200 must be refused")
    };
    assert!((x / 1e200 - 1.0).abs() < 1e-12);
}

#[test]
fn clouds_must_have_three_points_at_two_places() {
    for len in 0..3 {
        let message = |name| format!("{name} has {len} points; at least 3 are needed");
        let few = Error::TooFewPoints { argument: Argument::Src, len };
        assert_fails(&with_source(|points| points.truncate(len)), &few, &message("src"));
        let few = Error::TooFewPoints { argument: Argument::Tgt, len };
        assert_fails(&with_target(|points| points.truncate(len)), &few, &message("tgt"));
    }
    let here = Point3::new(1.0, 2.0, 3.0);
    assert_fails(
        &with_source(|points| points.fill(here)),
        &Error::NoExtent { argument: Argument::Src },
        "all points of src coincide; a resolution cannot be estimated from it",
    );
    assert_fails(
        &with_target(|points| points.fill(here)),
        &Error::NoExtent { argument: Argument::Tgt },
        "all points of tgt coincide; a resolution cannot be estimated from it",
    );
}

#[test]
fn clouds_must_be_in_the_same_unit() {
    let scene = easy();
    let in_mm = |points: &mut Vec<Point3<f64>>| points.iter_mut().for_each(|p| p.coords *= 1000.0);
    for (input, small, large) in [
        (with_source(in_mm), Argument::Tgt, Argument::Src),
        (with_target(in_mm), Argument::Src, Argument::Tgt),
    ] {
        let got = input.register().unwrap_err();
        assert!(
            matches!(got, Error::DifferentUnits { small: s, large: l, extent, spacing }
                if s == small && l == large && extent < spacing),
            "{got:?}"
        );
        let message = got.to_string();
        assert!(
            message.starts_with(&format!("{small} is ")) && message.contains(&format!("of {large} are "))
        );
        assert!(message.ends_with("apart; are both in the same unit?") && !message.contains('\n'));
    }
    // Both in millimetres are fine.
    assert!(!Input::of(&scene.scaled(1000.0)).register().unwrap().poses.is_empty());
}

#[test]
fn normals_must_fit() {
    let scene = easy();
    let (n, m) = (scene.source.len(), scene.target.len());
    let up = |len| vec![Vector3::new(0.0, 0.0, 2.0); len];
    let input = |src: Option<Vec<Vector3<f64>>>, tgt: Option<Vec<Vector3<f64>>>| {
        let mut input = Input::good();
        if let Some(normals) = src {
            input.source = input.source.with_normals(normals);
        }
        if let Some(normals) = tgt {
            input.target = input.target.with_normals(normals);
        }
        input
    };
    assert!(input(Some(up(n)), Some(up(m))).register().is_ok());
    assert_fails(
        &input(Some(up(n)), None),
        &Error::NormalsOfOneCloud { given: Argument::SrcNormals, missing: Argument::TgtNormals },
        "src_normals is given but tgt_normals is not; give normals for both clouds or for neither",
    );
    assert_fails(
        &input(None, Some(up(m))),
        &Error::NormalsOfOneCloud { given: Argument::TgtNormals, missing: Argument::SrcNormals },
        "tgt_normals is given but src_normals is not; give normals for both clouds or for neither",
    );
    assert_fails(
        &input(Some(up(n - 1)), Some(up(m))),
        &Error::LengthMismatch { argument: Argument::SrcNormals, len: n - 1, of: Argument::Src, expected: n },
        "src_normals has 99 rows; it must have one for each of the 100 rows of src",
    );
    assert_fails(
        &input(Some(up(n)), Some(up(m + 1))),
        &Error::LengthMismatch { argument: Argument::TgtNormals, len: m + 1, of: Argument::Tgt, expected: m },
        "tgt_normals has 251 rows; it must have one for each of the 250 rows of tgt",
    );
    let spoilt = |len, row: usize, value| {
        let mut normals = up(len);
        normals[row] = value;
        Some(normals)
    };
    assert_fails(
        &input(spoilt(n, 5, Vector3::zeros()), Some(up(m))),
        &Error::ZeroNormal { argument: Argument::SrcNormals, row: 5 },
        "src_normals[5] has length 0; a normal must have a direction",
    );
    assert_fails(
        &input(Some(up(n)), spoilt(m, 7, Vector3::new(f64::NAN, 0.0, 1.0))),
        &not_finite(Argument::TgtNormals, 7, [f64::NAN, 0.0, 1.0]),
        "tgt_normals[7] is [NaN, 0, 1]; coordinates must be finite and below 1e100",
    );
}

#[test]
fn correspondences_must_point_into_the_clouds() {
    let with_row = |row: [usize; 2]| {
        let mut rows = easy().rows;
        rows[4] = row;
        Input { correspondences: Correspondences::from_rows(rows), ..Input::good() }
    };
    assert_fails(
        &with_row([100, 0]),
        &Error::IndexOutOfRange { row: 4, column: 0, index: 100, len: 100 },
        "corr[4, 0] is 100; src has rows 0 to 99",
    );
    assert_fails(
        &with_row([0, 250]),
        &Error::IndexOutOfRange { row: 4, column: 1, index: 250, len: 250 },
        "corr[4, 1] is 250; tgt has rows 0 to 249",
    );
    // A negative index, wrapped by the caller's cast.
    assert_fails(
        &with_row([0, usize::MAX]),
        &Error::IndexOutOfRange { row: 4, column: 1, index: -1, len: 250 },
        "corr[4, 1] is -1; tgt has rows 0 to 249",
    );
}

#[test]
fn similarities_must_fit() {
    let rows = easy().rows;
    let with = |similarity| Input {
        correspondences: Correspondences::from_rows(rows.clone()).with_similarity(similarity),
        ..Input::good()
    };
    assert!(with(vec![0.5; rows.len()]).register().is_ok());
    assert_fails(
        &with(vec![0.5; rows.len() - 1]),
        &Error::LengthMismatch {
            argument: Argument::Similarity,
            len: 259,
            of: Argument::Corr,
            expected: 260,
        },
        "similarity has 259 rows; it must have one for each of the 260 rows of corr",
    );
    for (bad, word) in [(f64::NAN, "NaN"), (f64::INFINITY, "inf")] {
        let mut similarity = vec![0.5; rows.len()];
        similarity[9] = bad;
        assert_fails(
            &with(similarity),
            &Error::Similarity { row: 9, value: bad },
            &format!("similarity[9] is {word}; it must be finite"),
        );
    }
}

#[test]
fn a_selection_by_similarity_needs_one() {
    let mut input = Input::good();
    input.params.scs = Nnsr::default().into();
    assert_fails(
        &input,
        &Error::Missing { argument: Argument::Similarity },
        "similarity is not given, and the seed selection of params.scs needs it; give it, or take another variant",
    );
    input.correspondences = input.correspondences.with_similarity(easy().similarity());
    assert!(input.register().is_ok());
}

/// (what to change, the parameter blamed, its value, what is allowed).
type BadParam = (Box<dyn Fn(&mut Params)>, &'static str, f64, &'static str);

fn bad(
    change: impl Fn(&mut Params) + 'static,
    name: &'static str,
    value: f64,
    allowed: &'static str,
) -> BadParam {
    (Box::new(change), name, value, allowed)
}

fn bad_params() -> Vec<BadParam> {
    const LENGTH: &str = "between 1e-9 and 1e9";
    const OR_0: &str = "0 or between 1e-9 and 1e9";
    const SECONDS: &str = "between 0 and 1e9 seconds";
    const SHARE: &str = "between 0 and 1";
    let mut all = Vec::new();
    for x in [0.0, -1.0, 1e-10, 1e10, f64::NAN, f64::INFINITY] {
        all.push(bad(move |p| p.resolution = Some(x), "resolution", x, LENGTH));
        all.push(bad(move |p| p.delta_r_pr = x, "delta_r_pr", x, LENGTH));
        all.push(bad(move |p| p.t_he_pr = x, "t_he_pr", x, LENGTH));
        all.push(bad(move |p| p.d_op_pr = x, "d_op_pr", x, LENGTH));
    }
    for x in [-1.0, 1e-10, 1e10, f64::NAN, f64::INFINITY] {
        let gsac = move |p: &mut Params| p.te = Gsac { min_height_pr: x, ..Gsac::default() }.into();
        let ransac = move |p: &mut Params| p.te = Ransac { min_height_pr: x, ..Ransac::default() }.into();
        all.push(bad(gsac, "te.min_height_pr", x, OR_0));
        all.push(bad(ransac, "te.min_height_pr", x, OR_0));
    }
    for x in [-0.1, 1.1, f64::NAN] {
        all.push(bad(
            move |p| p.hv = Overlap { t_overlap: x, ..Overlap::default() }.into(),
            "hv.t_overlap",
            x,
            SHARE,
        ));
        all.push(bad(
            move |p| p.hv = Evidence { t_score: x, ..Evidence::default() }.into(),
            "hv.t_score",
            x,
            SHARE,
        ));
    }
    for x in [-1.0, 2e9, f64::NAN, f64::INFINITY] {
        all.push(bad(move |p| p.timeout_s = Some(x), "timeout_s", x, SECONDS));
    }
    for x in [-1.1, 1.1, f64::NAN] {
        all.push(bad(move |p| p.min_normal_cos = Some(x), "min_normal_cos", x, "between -1 and 1"));
    }
    all.push(bad(|p| p.n_contest = 0, "n_contest", 0.0, "at least 1"));
    for n in 0..3 {
        let gtm = move |p: &mut Params| p.scs = Gtm { n_downsample: n, ..Gtm::default() }.into();
        all.push(bad(move |p| p.t_s = n, "t_s", n.into(), "at least 3"));
        all.push(bad(move |p| p.ce = Voting { n_vot: n }.into(), "ce.n_vot", n.into(), "at least 3"));
        all.push(bad(gtm, "scs.n_downsample", n.into(), "at least 3"));
    }
    let hough = |p: &mut Params| p.scs = Hough3d { bin_pr: 0.0, ..Hough3d::default() }.into();
    all.push(bad(hough, "scs.bin_pr", 0.0, "between 1e-9 and 1e9"));
    let hough = |p: &mut Params| p.scs = Hough3d { frame_radius_pr: 2e9, ..Hough3d::default() }.into();
    all.push(bad(hough, "scs.frame_radius_pr", 2e9, "between 1e-9 and 1e9"));
    all.push(bad(|p| p.scs = Nnsr { n_nnsr: 2 }.into(), "scs.n_nnsr", 2.0, "at least 3"));
    let gtm = |p: &mut Params| p.scs = Gtm { n_downsample: 16_385, ..Gtm::default() }.into();
    all.push(bad(gtm, "scs.n_downsample", 16_385.0, "at most 16384 (1 GiB of payoffs)"));
    let gtm = |p: &mut Params| p.scs = Gtm { n_gtm: 0, ..Gtm::default() }.into();
    all.push(bad(gtm, "scs.n_gtm", 0.0, "at least 1"));
    let gsac = |p: &mut Params| p.te = Gsac { n_gsac: 0, ..Gsac::default() }.into();
    all.push(bad(gsac, "te.n_gsac", 0.0, "at least 1"));
    let ransac = |p: &mut Params| p.te = Ransac { n_ransac: 0, ..Ransac::default() }.into();
    all.push(bad(ransac, "te.n_ransac", 0.0, "at least 1"));
    let ransac = |p: &mut Params| p.te = Ransac { n_ransac: 10_000_001, ..Ransac::default() }.into();
    all.push(bad(ransac, "te.n_ransac", 10_000_001.0, "at most 10,000,000"));
    let sac_cot = |p: &mut Params| p.te = SacCot { n_sac_cot: 0, ..SacCot::default() }.into();
    all.push(bad(sac_cot, "te.n_sac_cot", 0.0, "at least 1"));
    let sac_cot = |p: &mut Params| p.te = SacCot { t_cmp: 1.1, ..SacCot::default() }.into();
    all.push(bad(sac_cot, "te.t_cmp", 1.1, SHARE));
    let sac_cot = |p: &mut Params| p.te = SacCot { max_triangles: 0, ..SacCot::default() }.into();
    all.push(bad(sac_cot, "te.max_triangles", 0.0, "at least 1"));
    let mac = |p: &mut Params| p.te = Mac { d_cmp_pr: 0.0, ..Mac::default() }.into();
    all.push(bad(mac, "te.d_cmp_pr", 0.0, "between 1e-9 and 1e9"));
    let mac = |p: &mut Params| p.te = Mac { t_sog: -0.1, ..Mac::default() }.into();
    all.push(bad(mac, "te.t_sog", -0.1, SHARE));
    let mac = |p: &mut Params| p.te = Mac { max_cliques: 1_000_000_001, ..Mac::default() }.into();
    all.push(bad(mac, "te.max_cliques", 1_000_000_001.0, "at most 1,000,000,000"));
    let mac = |p: &mut Params| p.te = Mac { max_steps: 0, ..Mac::default() }.into();
    all.push(bad(mac, "te.max_steps", 0.0, "at least 1"));
    let count = |p: &mut Params| p.hv = InlierCount { t_inliers: 0 }.into();
    all.push(bad(count, "hv.t_inliers", 0.0, "at least 1"));
    all
}

#[test]
fn parameters_must_be_in_range() {
    for (change, name, value, allowed) in bad_params() {
        let mut input = Input::good();
        change(&mut input.params);
        let error = Error::Param { name, value, allowed };
        assert_fails(&input, &error, &format!("params.{name} is {value}; it must be {allowed}"));
    }
    for preset in [
        Params::default(),
        Params::paper_synthetic(),
        Params::paper_real(),
        Params::single_view(),
        Params::many_views(),
    ] {
        assert_eq!(preset.validate(), Ok(()));
    }
}

#[test]
fn the_ends_of_the_ranges_are_legal() {
    let ends: Vec<fn(&mut Params)> = vec![
        |p| p.resolution = Some(1e-9),
        |p| p.resolution = Some(1e9),
        |p| p.delta_r_pr = 1e-9,
        |p| p.delta_r_pr = 1e9,
        |p| p.t_he_pr = 1e-9,
        |p| p.t_he_pr = 1e9,
        |p| p.d_op_pr = 1e-9,
        |p| p.d_op_pr = 1e9,
        |p| p.t_s = 3,
        |p| p.t_s = u32::MAX,
        |p| p.seed = u64::MAX,
        |p| p.timeout_s = Some(1e9),
        |p| p.scs = Gtm { n_downsample: 3, n_gtm: 1, payoff: Payoff::Ratio }.into(),
        |p| p.scs = Gtm { n_downsample: 16_384, ..Gtm::default() }.into(),
        |p| p.scs = Hough3d { bin_pr: 1e-9, frame_radius_pr: 1e9 }.into(),
        |p| p.scs = Hough3d { bin_pr: 1e9, frame_radius_pr: 1e-9 }.into(),
        |p| p.ce = Voting { n_vot: 3 }.into(),
        |p| p.ce = Voting { n_vot: u32::MAX }.into(),
        |p| p.te = Gsac { n_gsac: 1, min_height_pr: 0.0 }.into(),
        |p| p.te = Gsac { min_height_pr: 1e9, ..Gsac::default() }.into(),
        |p| p.te = Ransac { n_ransac: 1, min_height_pr: 0.0 }.into(),
        |p| p.te = SacCot { n_sac_cot: 1, t_cmp: 0.0, max_triangles: 1, ..SacCot::default() }.into(),
        |p| p.te = SacCot { d_cmp_pr: 1e-9, t_cmp: 1.0, ..SacCot::default() }.into(),
        |p| p.te = Mac { t_cmp: 0.0, t_sog: 0.0, max_cliques: 1, max_steps: 1, d_cmp_pr: 1e9 }.into(),
        |p| p.te = Mac { t_sog: 1.0, max_cliques: 1_000_000_000, ..Mac::default() }.into(),
        |p| p.hv = Overlap { t_overlap: 0.0, ..Overlap::default() }.into(),
        |p| p.hv = Overlap { t_overlap: 1.0, ..Overlap::default() }.into(),
        |p| p.hv = Evidence { t_score: 0.0, ..Evidence::default() }.into(),
        |p| p.hv = Evidence { t_score: 1.0, ..Evidence::default() }.into(),
        |p| p.hv = InlierCount { t_inliers: u32::MAX }.into(),
        |p| p.n_contest = u32::MAX,
        |p| p.max_rounds = Some(u32::MAX),
        |p| p.max_instances = Some(u32::MAX),
    ];
    for (i, change) in ends.into_iter().enumerate() {
        let mut input = Input::good();
        change(&mut input.params);
        let result = input.register().unwrap_or_else(|e| panic!("end {i}: {e}"));
        let finite =
            |pose: &ibi_core::Pose| pose.target_from_source.to_homogeneous().iter().all(|x| x.is_finite());
        assert!(result.poses.iter().all(finite), "end {i}");
    }
}

#[test]
fn unusual_input_gives_good_results() {
    let found = |scene: &Scene, input: &Input| {
        let poses: Vec<_> =
            input.register().unwrap().poses.iter().map(|pose| pose.target_from_source).collect();
        let extent = scene.source.iter().map(|p| p.coords.norm()).fold(0.0, f64::max);
        scene.hits(&poses, 0.05, 0.05 * extent)
    };
    for scene in [easy(), easy().offset(1e6), easy().offset(-1e8), easy().scaled(1e-6), easy().scaled(1e6)] {
        assert_eq!(found(&scene, &Input::of(&scene)), 2);
    }
    // Correspondences between points that are in neither cloud.
    let scene = easy();
    let between = |&[s, t]: &[usize; 2]| [scene.source[s], scene.target[t]];
    let points = scene.rows.iter().map(between).collect();
    let input = Input { correspondences: Correspondences::from_points(points), ..Input::good() };
    assert_eq!(found(&scene, &input), 2);
    // Normals of any length, a viewpoint.
    let long = |n: usize| (1..=n).map(|i| Vector3::new(i as f64, 1e-3, -50.0)).collect();
    let mut input = Input::good();
    input.source = input.source.with_normals(long(scene.source.len()));
    input.target =
        input.target.with_normals(long(scene.target.len())).with_viewpoint(Point3::new(0.0, 0.0, 9.0));
    assert_eq!(found(&scene, &input), 2);
    // A source registered to itself, with some wrong rows among the right ones.
    let rows = (0..100).map(|i| [i, i]).chain((0..20).map(|i| [i, 99 - 3 * i])).collect();
    let twin = Scene {
        target: scene.source.clone(),
        truth: vec![ibi_core::nalgebra::Isometry3::identity()],
        rows,
        ..scene
    };
    assert_eq!(found(&twin, &Input::of(&twin)), 1);
}

/// Coordinates just below the limit: whatever comes out is finite and comes out soon.
#[test]
fn extreme_coordinates_end_in_a_result_or_an_error() {
    for exponent in [-120, -60, -20, 20, 60, 99] {
        let scene = easy().scaled(10_f64.powi(exponent));
        for te in ibi_core::stages::te::Te::all() {
            let mut input = Input::of(&scene);
            input.params.te = te;
            match input.register() {
                Ok(result) => {
                    for pose in result.poses {
                        assert!(pose.target_from_source.to_homogeneous().iter().all(|x| x.is_finite()));
                    }
                }
                Err(error) => assert!(!error.to_string().contains('\n')),
            }
        }
    }
}

#[test]
fn one_absurd_correspondence_ends_in_a_result() {
    for payoff in [Payoff::Gaussian, Payoff::Ratio] {
        for far in [1e20, 1e50, 9e99] {
            let scene = easy();
            let between = |&[s, t]: &[usize; 2]| [scene.source[s], scene.target[t]];
            let mut points: Vec<_> = scene.rows.iter().map(between).collect();
            points[0][1] = Point3::new(far, 0.0, 0.0);
            let mut input = Input { correspondences: Correspondences::from_points(points), ..Input::good() };
            input.params.scs = Gtm { payoff, ..Gtm::default() }.into();
            let result = input.register().unwrap();
            assert!(!matches!(result.stop_reason, StopReason::Stalled));
        }
    }
}
