use crate::error::Error;
use crate::kernels::overlap::{Place, overlap_of};
use crate::ranges::share;
use crate::stages::{Context, Hypothesis, Validate, Verdict};

/// `overlap`: accepts a pose if more than `t_overlap` of the source points come to lie within `d_op` of a
/// target point (Quan et al. 2018).
///
/// A depth camera sees at most about half of an object, so for scenes from one view the threshold must be
/// lower, about 0.3 to 0.4.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct Overlap {
    /// `t_overlap`: the share to exceed. 0 to 1.
    pub t_overlap: f64,
    /// Whether target points that an accepted instance explains support no later one, so that an instance is
    /// found once.
    pub exclusive: bool,
}

impl Default for Overlap {
    fn default() -> Self {
        Self { t_overlap: 0.85, exclusive: false }
    }
}

impl Overlap {
    pub(super) fn check(&self) -> Result<(), Error> {
        share("hv.t_overlap", self.t_overlap)
    }
}

impl Validate for Overlap {
    fn validate(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Verdict {
        let scene = context.scene;
        let pose = &hypothesis.target_from_source;
        let claims = context.claims.near(pose);
        let value = if self.exclusive && !claims.is_empty() {
            let mut places = scene.places(pose);
            let on = places.iter().enumerate().filter_map(|(i, place)| match place {
                Place::On(row) => Some((i, *row)),
                _ => None,
            });
            let (on, rows): (Vec<usize>, Vec<u32>) = on.unzip();
            for (i, is_claimed) in on.into_iter().zip(claims.contain(&rows)) {
                if is_claimed {
                    places[i] = Place::Free;
                }
            }
            overlap_of(&places)
        } else {
            scene.overlap(pose)
        };
        Verdict { value, threshold: self.t_overlap }
    }
}
