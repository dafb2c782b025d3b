//! Errors of poses and scores of scenes, of anything.
#![no_main]

use arbitrary::{Result, Unstructured};
use ibi_core::metrics::{
    Criterion, Matching, Model, PoseThresholds, assignment, diameter, frobenius_distance, mean_score,
    mssd_recall, rotation_error_rad, score_scene, translation_error,
};
use ibi_core::{Interrupt, Symmetries};
use ibi_fuzz::{motion, number, points};
use libfuzzer_sys::fuzz_target;

fn metrics(u: &mut Unstructured<'_>) -> Result<()> {
    let never = Interrupt::never();
    let model = Model::new(points(u, 40)?);
    let poses =
        |u: &mut Unstructured<'_>| (0..u.int_in_range(0..=6)?).map(|_| motion(u)).collect::<Result<Vec<_>>>();
    let (predicted, truth) = (poses(u)?, poses(u)?);
    for (a, b) in predicted.iter().zip(&truth) {
        assert!((0.0..=3.1416).contains(&rotation_error_rad(a, b)));
        assert!(translation_error(a, b) >= 0.0 && frobenius_distance(a, b) >= 0.0);
    }
    let none = Symmetries::none();
    if let Ok(model) = &model {
        assert!(diameter(model.points(), &never).is_ok_and(|diameter| diameter >= 0.0));
        for (a, b) in predicted.iter().zip(&truth) {
            let add_s = model.add_s(a, b, &never).expect("nobody interrupts");
            assert!(add_s <= model.add(a, b) * (1.0 + 1e-9) + 1e-9 * model.add(a, a));
            assert!(model.mssd(a, b, &none, &never).is_ok_and(|mssd| mssd >= model.add(a, b) * (1.0 - 1e-9)));
        }
        let criteria = [
            Criterion::Pose(PoseThresholds::ecc()),
            Criterion::AddS { model, diameter_fraction: number(u)? },
        ];
        for criterion in criteria {
            for matching in Matching::ALL {
                let score = score_scene(&predicted, &truth, matching, &criterion, &never);
                let score = score.expect("nobody interrupts");
                assert!((0.0..=1.0).contains(&score.recall) && (0.0..=1.0).contains(&score.precision));
                assert!(mean_score(&[score]).is_ok());
            }
        }
        assert!(mssd_recall(model, &predicted, &truth, &none, Matching::OneToOne, &never).is_ok());
    }
    let (rows, cols) = (u.int_in_range(0..=7)?, u.int_in_range(0..=7)?);
    let cost = (0..rows * cols).map(|_| number(u)).collect::<Result<Vec<_>>>()?;
    if cost.iter().all(|x| x.is_finite()) {
        let assigned = assignment(&cost, rows, cols, &never).expect("nobody interrupts");
        assert_eq!(assigned.iter().flatten().count(), rows.min(cols));
    }
    Ok(())
}

fuzz_target!(|data: &[u8]| {
    let _ = metrics(&mut Unstructured::new(data));
});
