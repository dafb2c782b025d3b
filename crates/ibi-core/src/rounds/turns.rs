//! Trying a pose the other ways round: parts that look alike from several sides are often found turned.

use super::candidates::Candidate;
use super::closely::Looked;
use super::stages::Stages;
use super::state::State;
use crate::detail::Detail;
use crate::grace::Grace;
use crate::params::Refine;
use crate::stages::Hypothesis;

/// How many of the turned poses are looked at closely.
const NUM_TURNS: usize = 4;

impl State<'_> {
    /// Turns the best candidate about if it fits better that way ([`Refine::IcpTurns`]). Whether there was time for it.
    pub(super) fn turn_best(&mut self, stages: &Stages<'_>, grace: &mut Grace<'_>) -> bool {
        let scene = &self.problem.scene;
        if stages.params.refine != Refine::IcpTurns || !scene.is_one_sided() {
            return true;
        }
        let Some(at) = self.contest.best() else { return true };
        let Candidate { hypothesis, value, round, .. } = self.contest.candidates[at];
        let context = self.context(stages.params, round);
        let turns = scene.source.turns();
        let cost = self.problem.cost_of_look();
        let glances = grace.map(
            turns.len(),
            |_| 2 * cost,
            |i| {
                let pose = scene.icp(Detail::Glance, &(hypothesis.target_from_source * turns[i]));
                let claims = context.claims.near(&pose);
                (scene.fit(Detail::Glance, &pose, |rows| claims.contain(rows)).share, pose)
            },
        );
        let Some(mut glances) = glances.into_iter().collect::<Option<Vec<_>>>() else { return false };
        glances.sort_by(|(a, _), (b, _)| b.total_cmp(a));
        let mut best = None;
        let mut best_value = value;
        for (_, pose) in &glances[..NUM_TURNS] {
            if !grace.allows(8 * cost) {
                return false;
            }
            let target_from_source = scene.icp(Detail::Look, pose);
            let turned = Hypothesis { target_from_source, ..hypothesis };
            let looked = stages.look_closely(&context, &turned, self.instances.company());
            if looked.verdict.value > best_value {
                best_value = looked.verdict.value;
                best = Some(looked);
            }
        }
        if let Some(Looked { hypothesis, verdict, proof }) = best {
            let candidate = &mut self.contest.candidates[at];
            *candidate = Candidate { hypothesis, value: verdict.value, proof, ..*candidate };
        }
        true
    }
}
