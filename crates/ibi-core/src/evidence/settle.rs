//! A better pose close by: the last polish, on all that was measured.
//!
//! Points that lie on their surface pull a pose across it and never along it; what holds it there is where the part ends. That is a
//! count, and has no slope to follow. So poses around are tried, along the motions that the data hold least, in ever smaller steps.

use nalgebra::{Isometry3, Vector6};

/// What a search for a better pose tries, and when it ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Steps {
    /// The first one, data units.
    pub first: f64,
    /// No step is smaller.
    pub least: f64,
    /// How far the surface may move across itself in a step, data units: stiff motions take smaller ones.
    pub across: f64,
    /// Rounds at most.
    pub rounds: u32,
}

/// The best of the poses that a pattern search from `start` comes by, and its value (Hooke & Jeeves 1961).
///
/// In each round `motions` gives directions from where it stands, best first: a motion of a pose, of unit length, and by how much
/// (root mean square, data units) it moves the surface across itself. Each is tried forwards and backwards by `shifted`; what has
/// more `value` is where the next is tried from. A round without success halves the step.
pub fn settle(
    start: &Isometry3<f64>,
    steps: Steps,
    mut motions: impl FnMut(&Isometry3<f64>) -> Vec<(Vector6<f64>, f64)>,
    shifted: impl Fn(&Isometry3<f64>, &Vector6<f64>) -> Isometry3<f64>,
    mut value: impl FnMut(&Isometry3<f64>) -> f64,
) -> (Isometry3<f64>, f64) {
    let (mut best, mut most) = (*start, value(start));
    let mut step = steps.first;
    for _ in 0..steps.rounds {
        let mut has_moved = false;
        for (motion, across) in motions(&best) {
            let length = if across * step > steps.across { steps.across / across } else { step };
            for way in [length, -length] {
                let tried = shifted(&best, &(way * motion));
                let worth = value(&tried);
                if worth > most {
                    (best, most, has_moved) = (tried, worth, true);
                    break;
                }
            }
        }
        if !has_moved {
            step *= 0.5;
            if step < steps.least {
                break;
            }
        }
    }
    (best, most)
}
