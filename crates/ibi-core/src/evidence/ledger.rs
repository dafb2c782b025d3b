//! Which of many poses explain a scene point, nearest first: worked out once for all of them, and kept while one after the
//! other is dropped.
//!
//! To ask every pose for every other at each drop takes the third power of the poses on top of each other.

use nalgebra::{Isometry3, Point3};

use crate::grace::Grace;
use crate::kernels::par;
use crate::scene::Scene;

/// A claim to a row: how far it is from the instance, and which that is. Of equals the one found first comes first.
type Claim = (f64, u32);

/// Claims to a row that are kept, the nearest ones, where more poses than this explain it; and how few of them are left when
/// they are looked for anew.
const MOST: usize = 256;
const FEW: usize = 64;

/// Instances whose claims are worked out at a time, before what is too much is forgotten.
const BLOCK: usize = 64;

/// The claims of accepted instances to rows of the target that matter to them.
#[derive(Debug)]
pub(crate) struct Ledger<'a> {
    scene: &'a Scene<'a>,
    poses: Vec<Isometry3<f64>>,
    is_out: Vec<bool>,
    /// For each row of the target one more than its place in `rows`, or 0. Empty if no row matters.
    places: Vec<u32>,
    rows: Vec<Row>,
    /// The places in which each instance has a claim that is kept, and others.
    claimed: Vec<Vec<u32>>,
}

#[derive(Debug, Clone, Default)]
struct Row {
    /// Of the target.
    id: u32,
    /// Ascending.
    claims: Vec<Claim>,
    /// Whether there are more.
    is_cut: bool,
}

impl Row {
    fn keep_nearest(&mut self) {
        let order = |a: &Claim, b: &Claim| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
        if self.claims.len() > MOST {
            self.claims.select_nth_unstable_by(MOST, order);
            self.claims.truncate(MOST);
            self.is_cut = true;
        }
        self.claims.sort_unstable_by(order);
    }
}

impl<'a> Ledger<'a> {
    /// A ledger of `poses`, without a row yet.
    pub(crate) fn new(scene: &'a Scene<'a>, poses: Vec<Isometry3<f64>>) -> Self {
        let n = poses.len();
        Self {
            scene,
            poses,
            is_out: vec![false; n],
            places: Vec::new(),
            rows: Vec::new(),
            claimed: vec![Vec::new(); n],
        }
    }

    /// Whether an instance competes still.
    pub(crate) fn holds(&self, instance: usize) -> bool {
        !self.is_out[instance]
    }

    /// Works out the claims of `instances` to `rows` of the target, at `cost` each. Those for which there is no time are out.
    pub(crate) fn enter(
        &mut self,
        rows: impl IntoIterator<Item = u32>,
        instances: &[usize],
        cost: usize,
        grace: &mut Grace<'_>,
    ) {
        for row in rows {
            if self.places.is_empty() {
                self.places = vec![0; self.scene.target.points.len()];
            }
            let place = &mut self.places[row as usize];
            if *place == 0 {
                self.rows.push(Row { id: row, ..Row::default() });
                *place = self.rows.len() as u32;
            }
        }
        for block in instances.chunks(BLOCK) {
            let claims = grace.map(block.len(), |_| cost, |i| self.explained(block[i]));
            for (&instance, claims) in block.iter().zip(claims) {
                self.is_out[instance] |= claims.is_none();
                for (place, gap) in claims.into_iter().flatten() {
                    self.rows[place as usize].claims.push((gap, instance as u32));
                }
            }
            for row in &mut self.rows {
                if row.claims.len() > 2 * MOST {
                    row.keep_nearest();
                }
            }
        }
        for (place, row) in (0..).zip(&mut self.rows) {
            row.keep_nearest();
            for &(_, instance) in &row.claims {
                self.claimed[instance as usize].push(place);
            }
        }
    }

    /// The places of the rows that an instance explains, and how far each is from it.
    fn explained(&self, instance: usize) -> Vec<(u32, f64)> {
        let (scene, pose) = (self.scene, &self.poses[instance]);
        // More than a row can be away, for rounding.
        let reach = scene.source.radius + 2.0 * scene.tolerances.d_op_pr * scene.resolution;
        let near = scene.near_target.within(&(pose * scene.source.centre), reach);
        let mut places: Vec<u32> = near.filter_map(|row| self.places[row as usize].checked_sub(1)).collect();
        places.sort_unstable();
        self.explained_of(instance, &places)
    }

    /// The same of some places.
    fn explained_of(&self, instance: usize, places: &[u32]) -> Vec<(u32, f64)> {
        let points = places.iter().map(|&place| (place, self.point(place)));
        let explained =
            self.scene.nearest_source(self.scene.tolerances.d_op_pr, &self.poses[instance], points);
        explained.into_iter().map(|(place, _, gap)| (place, gap)).collect()
    }

    fn point(&self, place: u32) -> Point3<f64> {
        self.scene.target.points[self.rows[place as usize].id as usize]
    }

    /// Whether a row goes to another instance than to `defendant`, of those that are near. `None` if that was not worked out.
    pub(crate) fn is_claimed(
        &self,
        row: u32,
        defendant: Option<usize>,
        is_near: impl Fn(usize) -> bool,
    ) -> Option<bool> {
        let place = self.places.get(row as usize)?.checked_sub(1)?;
        let Row { claims, is_cut, .. } = &self.rows[place as usize];
        for &(_, instance) in claims {
            let instance = instance as usize;
            if Some(instance) == defendant {
                return Some(false);
            }
            if is_near(instance) {
                return Some(true);
            }
        }
        (!is_cut).then_some(false)
    }

    /// Takes an instance out, and tells `changed` of those to whom a row that it had may have come free.
    pub(crate) fn take_out(&mut self, instance: usize, mut changed: impl FnMut(usize)) {
        self.is_out[instance] = true;
        let mut short = Vec::new();
        for place in std::mem::take(&mut self.claimed[instance]) {
            let row = &mut self.rows[place as usize];
            let Some(at) = row.claims.iter().position(|&(_, other)| other as usize == instance) else {
                continue;
            };
            row.claims.remove(at);
            match row.claims.first() {
                Some(&(_, next)) if at == 0 => changed(next as usize),
                None if !row.is_cut => self.each_around(place, &mut changed),
                _ => {}
            }
            if self.rows[place as usize].is_cut && self.rows[place as usize].claims.len() < FEW {
                short.push(place);
            }
        }
        self.refill(&short);
    }

    /// Tells `found` of the instances that a row within 2 `d_op` of them may matter to.
    fn each_around(&self, place: u32, mut found: impl FnMut(usize)) {
        let (scene, point) = (self.scene, self.point(place));
        // More than it can be away, for rounding.
        let reach = scene.source.radius + 2.5 * scene.tolerances.d_op_pr * scene.resolution;
        for (instance, pose) in self.poses.iter().enumerate() {
            if self.holds(instance) && (pose * scene.source.centre - point).norm() <= reach {
                found(instance);
            }
        }
    }

    /// Looks for the claims to some places anew.
    fn refill(&mut self, places: &[u32]) {
        if places.is_empty() {
            return;
        }
        let claims = par::map(self.poses.len(), 1, |instance| {
            if self.holds(instance) { self.explained_of(instance, places) } else { Vec::new() }
        });
        let before: Vec<Vec<Claim>> = places
            .iter()
            .map(|&place| {
                let row = &mut self.rows[place as usize];
                row.is_cut = false;
                std::mem::take(&mut row.claims)
            })
            .collect();
        for (instance, claims) in (0..).zip(claims) {
            for (place, gap) in claims {
                self.rows[place as usize].claims.push((gap, instance));
            }
        }
        for (&place, before) in places.iter().zip(before) {
            let row = &mut self.rows[place as usize];
            row.keep_nearest();
            for claim in &row.claims {
                if !before.contains(claim) {
                    self.claimed[claim.1 as usize].push(place);
                }
            }
        }
    }
}
