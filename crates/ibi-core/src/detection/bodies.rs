//! What hangs together in a cloud.

use nalgebra::Point3;

/// Points in cells of a lattice that touch each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Body {
    /// Diagonal of the box around them, data units.
    pub(super) across: f64,
    pub(super) num_cells: usize,
}

/// A cell of a lattice.
type Cell = [i64; 3];

/// The bodies of a cloud in a lattice of cells so wide.
pub(super) fn bodies(points: &[Point3<f64>], width: f64) -> Vec<Body> {
    let Some(&first) = points.first() else { return Vec::new() };
    let low = points.iter().fold(first, |low, p| low.inf(p));
    let cell = |p: &Point3<f64>| -> Cell { [0, 1, 2].map(|k| ((p[k] - low[k]) / width).floor() as i64) };
    let mut held: Vec<(Cell, usize)> = points.iter().map(cell).zip(0..).collect();
    held.sort_unstable();
    let cells: Vec<&[(Cell, usize)]> = held.chunk_by(|a, b| a.0 == b.0).collect();
    let of_cell = joined(&cells.iter().map(|rows| rows[0].0).collect::<Vec<_>>());

    let mut found: Vec<(Vec<Point3<f64>>, usize)> = vec![(Vec::new(), 0); cells.len()];
    for (rows, body) in cells.iter().zip(of_cell) {
        found[body].0.extend(rows.iter().map(|&(_, row)| points[row]));
        found[body].1 += 1;
    }
    found.retain(|body| body.1 > 0);
    found.into_iter().map(|(points, num_cells)| Body { across: across(&points), num_cells }).collect()
}

/// Diagonal of the box around points; 0 without any.
pub(super) fn across<'a>(points: impl IntoIterator<Item = &'a Point3<f64>>) -> f64 {
    let mut points = points.into_iter();
    let Some(&first) = points.next() else { return 0.0 };
    let (low, high) = points.fold((first, first), |(low, high), p| (low.inf(p), high.sup(p)));
    (high - low).norm()
}

/// For each of the cells, which are sorted, the first of those that it hangs together with.
fn joined(cells: &[Cell]) -> Vec<usize> {
    let mut parent: Vec<usize> = (0..cells.len()).collect();
    let root = |parent: &mut Vec<usize>, mut at: usize| {
        while parent[at] != at {
            parent[at] = parent[parent[at]];
            at = parent[at];
        }
        at
    };
    let steps = (0..27).map(|i| [i / 9 - 1, i / 3 % 3 - 1, i % 3 - 1]).filter(|step| *step > [0, 0, 0]);
    for step in steps {
        for (at, cell) in cells.iter().enumerate() {
            let beside = [0, 1, 2].map(|k| cell[k].saturating_add(step[k]));
            if let Ok(other) = cells.binary_search(&beside) {
                let (a, b) = (root(&mut parent, at), root(&mut parent, other));
                parent[a.max(b)] = a.min(b);
            }
        }
    }
    (0..cells.len()).map(|at| root(&mut parent, at)).collect()
}
