//! Sorting what is large: in runs, side by side, that are merged; so that it can be interrupted.

use super::par;
use crate::interrupt::Interrupt;
use crate::pace::Pace;

/// Items of a run: ten to twenty milliseconds.
const RUN: usize = 1 << 18;

/// The items in ascending order; `None` if interrupted. Equal ones must be the same.
pub(crate) fn sorted<T: Ord + Copy + Send + Sync>(
    mut items: Vec<T>,
    interrupt: &Interrupt,
) -> Option<Vec<T>> {
    if items.len() <= RUN {
        items.sort_unstable();
        return Some(items);
    }
    let mut runs = par::chunks(items.len(), RUN, |run| {
        let mut run = if interrupt.is_set() { Vec::new() } else { items[run].to_vec() };
        run.sort_unstable();
        run
    });
    drop(items);
    while runs.len() > 1 && !interrupt.is_set() {
        runs = par::map(runs.len().div_ceil(2), 1, |i| {
            let second = runs.get(2 * i + 1).map_or(&[][..], Vec::as_slice);
            merged(&runs[2 * i], second, interrupt)
        });
    }
    if interrupt.is_set() { None } else { runs.pop() }
}

/// Less than all if interrupted.
fn merged<T: Ord + Copy>(a: &[T], b: &[T], interrupt: &Interrupt) -> Vec<T> {
    const STRETCH: usize = 4096;
    let (mut i, mut j) = (0, 0);
    let mut all = Vec::with_capacity(a.len() + b.len());
    let mut pace = Pace::new(interrupt);
    while i < a.len() && j < b.len() && !pace.is_over(STRETCH) {
        for _ in 0..STRETCH {
            if i == a.len() || j == b.len() {
                break;
            }
            let is_first = a[i] <= b[j];
            all.push(if is_first { a[i] } else { b[j] });
            i += usize::from(is_first);
            j += usize::from(!is_first);
        }
    }
    all.extend_from_slice(&a[i..]);
    all.extend_from_slice(&b[j..]);
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_the_standard_library_sorts() {
        let mut rng = crate::kernels::rng::Rng::new(3, 0, 0);
        for len in [0, 1, RUN, RUN + 1, 5 * RUN + 77] {
            let items: Vec<(u64, u32)> =
                (0..len as u32).map(|row| (rng.below(len / 3 + 1) as u64, row)).collect();
            let mut expected = items.clone();
            expected.sort_unstable();
            assert_eq!(sorted(items, &Interrupt::never()), Some(expected));
        }
    }
}
