use crate::error::{Argument, Error};
use crate::ranges::at_least_3;
use crate::stages::{Context, Ranked, SelectSeeds};

/// `nnsr`: the alive correspondences of the most distinctive matches, by their nearest-neighbour similarity ratio, are the
/// seeds (Lowe 2004). Needs a similarity for each correspondence; seeds of earlier rounds that may not lead again are none.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct Nnsr {
    /// Seeds of a round. At least 3.
    // PAPER: how many it takes is not said. About as many as `gtm` finds.
    pub n_nnsr: u32,
}

impl Default for Nnsr {
    fn default() -> Self {
        Self { n_nnsr: 20 }
    }
}

impl Nnsr {
    pub(super) fn check(&self) -> Result<(), Error> {
        at_least_3("scs.n_nnsr", self.n_nnsr)
    }
}

impl SelectSeeds for Nnsr {
    fn select_seeds(&self, context: &Context<'_>) -> Ranked {
        // Refused at the begin of a run, see `needs`.
        let Some(similarity) = &context.pairs.similarity else { return Ranked::default() };
        let free = context.alive.ids().iter().copied().filter(|&id| !context.barred[id as usize]);
        let mut free: Vec<u32> = free.collect();
        let of = |id: u32| similarity[id as usize];
        let order = |a: &u32, b: &u32| of(*b).total_cmp(&of(*a)).then(a.cmp(b));
        let wanted = self.n_nnsr as usize;
        if wanted < free.len() {
            free.select_nth_unstable_by(wanted, order);
            free.truncate(wanted);
        }
        // A score is not negative, whatever the scale of the similarity: its place in the range of all. Halves, as the
        // range of finite numbers may not be one.
        let (least, most) =
            similarity.iter().fold((f64::MAX, f64::MIN), |(least, most), &s| (least.min(s), most.max(s)));
        let range = 0.5 * most - 0.5 * least;
        let score = |id: u32| if range > 0.0 { (0.5 * of(id) - 0.5 * least) / range } else { 1.0 };
        Ranked::new(free.into_iter().map(|id| (id, score(id) as f32)).collect())
    }

    fn needs(&self) -> Option<Argument> {
        Some(Argument::Similarity)
    }
}
