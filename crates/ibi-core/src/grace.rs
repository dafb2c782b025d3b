//! What a run may still do once it was ended from outside.

use crate::interrupt::Interrupt;
use crate::kernels::par;

/// Lets work through until the run is ended from outside, and then a bounded amount of it: counted in points that are looked
/// at and not in time, so that what was found before a callback ended the run does not depend on the machine.
#[derive(Debug)]
pub(crate) struct Grace<'a> {
    interrupt: &'a Interrupt,
    /// Points that may be looked at once the run is ended.
    amount: usize,
    /// What is left of them; `None` as long as the run goes on.
    left: Option<usize>,
}

/// Points to look at for each of what is done at the end: some tens of milliseconds.
pub(crate) const CONTEST: usize = 1 << 18;
pub(crate) const CHECK: usize = 1 << 19;
pub(crate) const POLISH: usize = 1 << 22;
pub(crate) const RANK: usize = 1 << 19;

impl<'a> Grace<'a> {
    /// `is_over`: whether the run has been ended already, by whatever means.
    pub(crate) fn new(interrupt: &'a Interrupt, amount: usize, is_over: bool) -> Self {
        Self { interrupt, amount, left: is_over.then_some(amount) }
    }

    /// Nothing more is done once the run is ended.
    pub(crate) fn none(interrupt: &'a Interrupt) -> Self {
        Self::new(interrupt, 0, false)
    }

    /// Whether the run was ended, as far as this has been asked.
    pub(crate) fn is_over(&self) -> bool {
        self.left.is_some()
    }

    /// Whether `cost` more points may be looked at. Once they may not, no others may either; but at first some may, however
    /// many.
    pub(crate) fn allows(&mut self, cost: usize) -> bool {
        if self.left.is_none() && self.interrupt.is_set() {
            self.left = Some(self.amount);
        }
        let Some(left) = &mut self.left else { return true };
        let is_enough = *left > 0 && (cost <= *left || *left == self.amount);
        *left = if is_enough { left.saturating_sub(cost) } else { 0 };
        is_enough
    }

    /// `(0..n).map(f)`, of which each costs so much; `None` where there was no time for it. Once the run is ended the first
    /// come first.
    pub(crate) fn map<T: Send>(
        &mut self,
        n: usize,
        cost: impl Fn(usize) -> usize,
        f: impl Fn(usize) -> T + Sync + Send,
    ) -> Vec<Option<T>> {
        let mut done: Vec<Option<T>> = if self.is_over() {
            (0..n).map(|_| None).collect()
        } else {
            par::map(n, 1, |i| (!self.interrupt.is_set()).then(|| f(i)))
        };
        let missing: Vec<usize> = (0..n).filter(|&i| done[i].is_none()).collect();
        let allowed: Vec<usize> = missing.into_iter().take_while(|&i| self.allows(cost(i))).collect();
        for (&i, made) in allowed.iter().zip(par::map(allowed.len(), 1, |k| f(allowed[k]))) {
            done[i] = Some(made);
        }
        done
    }
}
