//! The linear assignment problem.

use super::MetricsError;
use crate::interrupt::{Interrupt, Phase};
use crate::pace::Pace;

/// The assignment of rows to columns with the least total cost: `min(rows, cols)` pairs, no row and no
/// column twice.
///
/// `cost` is row-major, `cost[row * cols + col]`. Answers, for each row, its column, or `None` for a row
/// left over (which happens only with more rows than columns). Equal optima are told apart by the order of
/// rows and columns, so the answer is the same in every run.
///
/// Costs are finite by contract, of either sign. With others the answer is still a complete assignment,
/// though not a meaningful one.
///
/// Shortest augmenting paths with dual potentials: Jonker & Volgenant, "A shortest augmenting path algorithm
/// for dense and sparse linear assignment problems", Computing 38 (1987); without its
/// initialisation, which pays off only for problems far larger than the poses of a scene.
///
/// # Errors
///
/// [`MetricsError::Interrupted`].
///
/// # Panics
///
/// If `cost` does not hold `rows * cols` numbers.
///
/// # Complexity
///
/// O(n^2 m) with n the smaller and m the larger of `rows` and `cols`.
///
/// # Examples
///
/// ```
/// use ibi_core::Interrupt;
/// use ibi_core::metrics::assignment;
///
/// let never = Interrupt::never();
/// // Greedy would take the 1 and be left with the 9: 10. The best total is 2 + 3.
/// let cost = [1.0, 2.0, 3.0, 9.0];
/// assert_eq!(assignment(&cost, 2, 2, &never)?, [Some(1), Some(0)]);
/// // Three rows for two columns: one row stays alone.
/// let cost = [5.0, 5.0, 1.0, 9.0, 9.0, 1.0];
/// assert_eq!(assignment(&cost, 3, 2, &never)?, [None, Some(0), Some(1)]);
/// # Ok::<(), ibi_core::metrics::MetricsError>(())
/// ```
pub fn assignment(
    cost: &[f64],
    rows: usize,
    cols: usize,
    interrupt: &Interrupt,
) -> Result<Vec<Option<usize>>, MetricsError> {
    assert_eq!(cost.len(), rows * cols, "cost must hold rows * cols numbers");
    if !interrupt.enter(Phase::Metrics) {
        return Err(MetricsError::Interrupted);
    }
    // The search wants every agent served, so the agents are the shorter side.
    if rows <= cols {
        let (task_of, _) = assign(rows, cols, |row, col| cost[row * cols + col], interrupt)?;
        Ok(task_of)
    } else {
        let (_, agent_of) = assign(cols, rows, |col, row| cost[row * cols + col], interrupt)?;
        Ok(agent_of)
    }
}

/// The task of each agent, the agent of each task.
type Assigned = (Vec<Option<usize>>, Vec<Option<usize>>);

/// Assigns each of `agents` to one of at least as many `tasks`.
fn assign(
    agents: usize,
    tasks: usize,
    cost: impl Fn(usize, usize) -> f64,
    interrupt: &Interrupt,
) -> Result<Assigned, MetricsError> {
    let mut pace = Pace::new(interrupt);
    let mut task_of = vec![None; agents];
    let mut agent_of = vec![None; tasks];
    // Invariant: cost - agent_price - task_price is >= 0, and 0 on assigned pairs, so path lengths in these
    // reduced costs are never negative and Dijkstra's search is valid.
    let mut agent_price = vec![0.0; agents];
    let mut task_price = vec![0.0; tasks];

    for newcomer in 0..agents {
        let mut length = vec![f64::INFINITY; tasks];
        let mut reached_from = vec![newcomer; tasks];
        let mut settled = vec![false; tasks];
        let mut agent = newcomer;
        let mut travelled = 0.0;
        let free_task = loop {
            if pace.is_over(tasks) {
                return Err(MetricsError::Interrupted);
            }
            let mut nearest: Option<usize> = None;
            for task in (0..tasks).filter(|&task| !settled[task]) {
                let through = travelled + cost(agent, task) - agent_price[agent] - task_price[task];
                if through < length[task] {
                    length[task] = through;
                    reached_from[task] = agent;
                }
                if nearest.is_none_or(|best| length[task] < length[best]) {
                    nearest = Some(task);
                }
            }
            // There are at least as many tasks as agents, so an unserved newcomer always finds one.
            let Some(task) = nearest else { return Ok((task_of, agent_of)) };
            settled[task] = true;
            travelled = length[task];
            match agent_of[task] {
                Some(holder) => agent = holder,
                None => break task,
            }
        };

        // Restore the invariant along the searched tree before the assignment changes.
        agent_price[newcomer] += travelled;
        for task in (0..tasks).filter(|&task| settled[task]) {
            let slack = travelled - length[task];
            task_price[task] -= slack;
            if let Some(holder) = agent_of[task] {
                agent_price[holder] += slack;
            }
        }

        // Flip the path: each agent on it takes the task it was reached through and hands its old one back
        // along the path. The newcomer has none to hand back.
        let mut task = free_task;
        loop {
            let taker = reached_from[task];
            agent_of[task] = Some(taker);
            match task_of[taker].replace(task) {
                Some(given_up) => task = given_up,
                None => break,
            }
        }
    }
    Ok((task_of, agent_of))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn assignment(cost: &[f64], rows: usize, cols: usize) -> Vec<Option<usize>> {
        super::assignment(cost, rows, cols, &Interrupt::never()).unwrap()
    }

    fn total(cost: &[f64], cols: usize, columns: &[Option<usize>]) -> f64 {
        columns.iter().enumerate().filter_map(|(row, col)| col.map(|col| cost[row * cols + col])).sum()
    }

    /// The naive twin: every way to give the rows from `row` on a column, or none if some must stay alone.
    fn brute_force(cost: &[f64], rows: usize, cols: usize, row: usize, used: &mut Vec<bool>) -> f64 {
        if row == rows {
            return 0.0;
        }
        let mut best = f64::INFINITY;
        for col in 0..cols {
            if !used[col] {
                used[col] = true;
                best = best.min(cost[row * cols + col] + brute_force(cost, rows, cols, row + 1, used));
                used[col] = false;
            }
        }
        let free = used.iter().filter(|&&used| !used).count();
        if rows - row > free {
            best = best.min(brute_force(cost, rows, cols, row + 1, used));
        }
        best
    }

    fn problems() -> impl Strategy<Value = (usize, usize, Vec<f64>)> {
        (0..=6_usize, 0..=6_usize).prop_flat_map(|(rows, cols)| {
            // Small integers make ties common, real numbers make them rare: both must be right.
            let cell = prop_oneof![(-4..=4_i32).prop_map(f64::from), -10.0..10.0];
            (Just(rows), Just(cols), prop::collection::vec(cell, rows * cols))
        })
    }

    proptest! {
        #[test]
        fn is_complete_and_as_cheap_as_the_best_permutation((rows, cols, cost) in problems()) {
            let columns = assignment(&cost, rows, cols);
            prop_assert_eq!(columns.len(), rows);
            let mut taken: Vec<usize> = columns.iter().flatten().copied().collect();
            prop_assert_eq!(taken.len(), rows.min(cols));
            taken.sort_unstable();
            taken.dedup();
            prop_assert_eq!(taken.len(), rows.min(cols));
            let best = brute_force(&cost, rows, cols, 0, &mut vec![false; cols]);
            prop_assert!((total(&cost, cols, &columns) - best).abs() < 1e-9);
        }

        #[test]
        fn transposing_the_problem_keeps_the_total((rows, cols, cost) in problems()) {
            let transposed: Vec<f64> =
                (0..rows * cols).map(|k| cost[(k % rows) * cols + k / rows]).collect();
            let there = total(&cost, cols, &assignment(&cost, rows, cols));
            let back = total(&transposed, rows, &assignment(&transposed, cols, rows));
            prop_assert!((there - back).abs() < 1e-9);
        }
    }

    #[test]
    fn a_path_of_three_is_found() {
        // Each row's favourite is column 0. Totals of the six permutations (columns of rows 0, 1, 2):
        // 012: 1+4+9 = 14, 021: 1+6+6 = 13, 102: 2+2+9 = 13, 120: 2+6+3 = 11, 201: 3+2+6 = 11, 210: 3+4+3 = 10.
        let cost = [1.0, 2.0, 3.0, 2.0, 4.0, 6.0, 3.0, 6.0, 9.0];
        assert_eq!(assignment(&cost, 3, 3), [Some(2), Some(1), Some(0)]);
    }

    #[test]
    fn nothing_to_assign() {
        assert!(assignment(&[], 0, 4).is_empty());
        assert_eq!(assignment(&[], 3, 0), [None, None, None]);
    }

    #[test]
    fn costs_outside_the_contract_still_end() {
        let columns = assignment(&[f64::NAN, f64::INFINITY, f64::NAN, 1.0], 2, 2);
        let mut taken: Vec<_> = columns.into_iter().flatten().collect();
        taken.sort_unstable();
        assert_eq!(taken, [0, 1]);
    }
}
