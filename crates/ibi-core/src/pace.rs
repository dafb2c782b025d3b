//! Asking an [`Interrupt`] often enough, and not at every step.

use crate::interrupt::Interrupt;

/// Asks once in so much work: a unit is a few nanoseconds.
const WORK: usize = 1 << 16;

/// Counts the work of one thread.
pub(crate) struct Pace<'a> {
    interrupt: &'a Interrupt,
    done: usize,
}

impl<'a> Pace<'a> {
    pub(crate) fn new(interrupt: &'a Interrupt) -> Self {
        Self { interrupt, done: 0 }
    }

    /// Whether the computation is to end, `work` having been done since this was asked before.
    #[inline]
    pub(crate) fn is_over(&mut self, work: usize) -> bool {
        self.done += work;
        if self.done < WORK {
            return false;
        }
        self.done = 0;
        self.interrupt.is_set()
    }
}
