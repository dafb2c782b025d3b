//! How much of the model lies on the scene (Quan et al. 2018), and where.

use std::ops::Range;

use nalgebra::{Isometry3, Point3, Rotation3, Vector3};

use super::graph::up_to_sign;
use super::nearby::Nearby;
use super::par;
use super::rng::Rng;
use super::sight::{Eye, Sight, View, asked};

/// A cloud with its normals, if they are to count.
#[derive(Debug, Clone, Copy)]
pub struct Surface<'a> {
    /// The points.
    pub points: &'a [Point3<f64>],
    /// Unit normals, one per point.
    pub normals: Option<&'a [Vector3<f64>]>,
}

/// What it takes for a source point to lie on the target.
#[derive(Debug, Clone, Copy)]
pub struct Contact<'a> {
    /// Largest distance, data units.
    pub distance: f64,
    /// With normals: least cosine between them.
    pub min_normal_cos: f64,
    /// Whether the sign of a normal means something; else the magnitude of the cosine counts.
    pub oriented: bool,
    /// With oriented normals and a camera: points that it cannot see do not count.
    pub view: Option<View<'a>>,
    /// Whether distances are taken across the surface of the target.
    pub to_planes: bool,
}

/// Where a source point comes to lie.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Place {
    /// The camera cannot see it: it faces away, or is behind another part of the source, or behind something that the
    /// camera has measured.
    Hidden,
    /// The camera saw through it: what it measured there lies behind.
    Through,
    /// No target point is near enough, or the nearest one is turned away.
    Free,
    /// On this row of the target.
    On(u32),
}

/// Points whose nearest neighbours one thread looks up at a time: fewer are not worth waking another.
const GRAIN: usize = 2048;

/// Where each source point lies once the pose has moved it. `nearby` holds the target, within at least
/// `contact.distance`.
///
/// # Complexity
/// O(|source|) for targets that fill a surface.
#[must_use]
pub fn places(
    source: &Surface<'_>,
    target: &Surface<'_>,
    nearby: &Nearby,
    target_from_source: &Isometry3<f64>,
    contact: &Contact<'_>,
) -> Vec<Place> {
    let chunks = par::chunks(source.points.len(), GRAIN, |rows| {
        let mut places = vec![Place::Hidden; rows.len()];
        let first = rows.start;
        each_place(source, target, nearby, target_from_source, contact, rows, |i, place, _| {
            places[i - first] = place;
        });
        places
    });
    chunks.concat()
}

/// How closely the source lies on the target, [`overlap`] with a slope in the place of a step: it tells a snug fit from
/// a loose one.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Fit {
    /// Mean over the visible source points of max(0, 1 - d / reach), d being how far the point is from the nearest
    /// target point if that is not claimed and agrees in its normal; 0 if none is visible.
    pub mean: f64,
    /// The sum of the same over the number of all source points: how much of the source is explained. 0 to 1.
    pub share: f64,
}

/// Measures the [`Fit`] of a pose. `are_claimed` tells of each row of the target whether it is claimed.
///
/// # Complexity
/// As [`places`].
#[must_use]
pub fn fit(
    source: &Surface<'_>,
    target: &Surface<'_>,
    nearby: &Nearby,
    target_from_source: &Isometry3<f64>,
    contact: &Contact<'_>,
    are_claimed: impl Fn(&[u32]) -> Vec<bool> + Sync,
) -> Fit {
    let chunks = par::chunks(source.points.len(), GRAIN, |rows| {
        let (mut on, mut closeness) = (Vec::with_capacity(rows.len()), Vec::with_capacity(rows.len()));
        let mut visible = 0_u32;
        each_place(source, target, nearby, target_from_source, contact, rows, |_, place, gap| {
            visible += 1;
            if let Place::On(row) = place {
                on.push(row);
                closeness.push(contact.closeness(target, row, gap));
            }
        });
        let free = closeness.iter().zip(are_claimed(&on)).filter(|&(_, is_claimed)| !is_claimed);
        (visible, free.map(|(closeness, _)| closeness).sum::<f64>())
    });
    let visible: u32 = chunks.iter().map(|(visible, _)| visible).sum();
    let sum: f64 = chunks.iter().map(|(_, sum)| sum).sum();
    Fit { mean: sum / f64::from(visible.max(1)), share: sum / source.points.len().max(1) as f64 }
}

/// The fit of a pose that only chance has put somewhere on the target: the mean of `samples` source points, each turned
/// at random about another one that lies on a target point.
#[must_use]
pub fn chance_fit(
    source: &Surface<'_>,
    target: &Surface<'_>,
    nearby: &Nearby,
    contact: &Contact<'_>,
    mut rng: Rng,
    samples: usize,
) -> f64 {
    let drawn = (0..samples).map(|_| {
        let [i, about] = [(); 2].map(|()| rng.below(source.points.len()));
        let onto = target.points[rng.below(target.points.len())];
        let rotation = rng.rotation();
        let moved = onto + rotation * (source.points[i] - source.points[about]);
        (moved, source.normals.map(|normals| rotation * normals[i]))
    });
    let (moved, normals): (Vec<_>, Vec<_>) = drawn.unzip();
    let nearest = nearby.nearest_each(contact.distance, &moved);
    let closeness = |((moved, normal), row): ((_, _), Option<u32>)| {
        let (row, gap) = contact.gap(target, row?, moved, normal)?;
        Some(contact.closeness(target, row, gap))
    };
    let sum: f64 = moved.iter().zip(normals).zip(nearest).filter_map(closeness).sum();
    sum / samples.max(1) as f64
}

/// Points that are looked at for the fit of the target to itself: where the samples have so many neighbours fewer of them do.
const MOST_LOOKED_AT: usize = 1 << 22;

/// The fit of the target to itself, each of `samples` points to the nearest other one: no pose fits better than the
/// noise of the scene lets it. 1 if no point has a neighbour.
#[must_use]
pub fn own_fit(
    target: &Surface<'_>,
    nearby: &Nearby,
    contact: &Contact<'_>,
    mut rng: Rng,
    samples: usize,
) -> f64 {
    let (mut sum, mut count) = (0.0, 0_u32);
    let mut num_looked_at = 0;
    for _ in 0..samples {
        if num_looked_at > MOST_LOOKED_AT {
            break;
        }
        let i = rng.below(target.points.len());
        let gap_to = |row: &u32| target.points[i] - target.points[*row as usize];
        let others = nearby.within(&target.points[i], contact.distance).filter(|&row| row as usize != i);
        let others = others.inspect(|_| num_looked_at += 1);
        let nearest = others
            .min_by(|a, b| gap_to(a).norm_squared().total_cmp(&gap_to(b).norm_squared()).then(a.cmp(b)));
        if let Some(row) = nearest {
            let normal = target.normals.map_or_else(Vector3::zeros, |normals| normals[row as usize]);
            sum += contact.closeness(target, row, normal * normal.dot(&gap_to(&row)));
            count += 1;
        }
    }
    if count == 0 { 1.0 } else { sum / f64::from(count) }
}

impl Contact<'_> {
    /// The row of the target that a moved source point with a moved normal touches, and the way to it from there: `row`,
    /// the nearest, if that is near enough and its normal agrees.
    fn gap(
        &self,
        target: &Surface<'_>,
        row: u32,
        moved: &Point3<f64>,
        normal: Option<Vector3<f64>>,
    ) -> Option<(u32, Vector3<f64>)> {
        let gap = moved - target.points[row as usize];
        let agree = |(n, normals): (Vector3<f64>, &[Vector3<f64>])| {
            up_to_sign(n.dot(&normals[row as usize]), self.oriented) >= self.min_normal_cos
        };
        let touches = gap.norm() <= self.distance && normal.zip(target.normals).is_none_or(agree);
        touches.then_some((row, gap))
    }

    /// max(0, 1 - d / reach) of a point that lies `gap` from a row of the target. d is the length of the
    /// gap and the reach the distance. Across the surface the reach is half of that, and d the part of the gap along the
    /// normal, as how far the points of a thinned scan lie apart says nothing; but what lies farther aside than a third
    /// of the distance lies beyond the end of the surface, and by so much farther.
    fn closeness(&self, target: &Surface<'_>, row: u32, gap: Vector3<f64>) -> f64 {
        match target.normals {
            Some(normals) if self.to_planes => {
                let across = normals[row as usize].dot(&gap).abs();
                let along = (gap.norm_squared() - across * across).max(0.0).sqrt();
                let aside = (along - self.distance / 3.0).max(0.0);
                (1.0 - (across + aside) / (0.5 * self.distance)).max(0.0)
            }
            _ => 1.0 - gap.norm() / self.distance,
        }
    }
}

/// Tells `found(i, place, gap)` of each visible source point i of `rows`: where it lies, and the way to it from the
/// target point it lies on.
fn each_place(
    source: &Surface<'_>,
    target: &Surface<'_>,
    nearby: &Nearby,
    target_from_source: &Isometry3<f64>,
    contact: &Contact<'_>,
    rows: Range<usize>,
    mut found: impl FnMut(usize, Place, Vector3<f64>),
) {
    let rotation = target_from_source.rotation.to_rotation_matrix();
    let shift = target_from_source.translation.vector;
    let sighted = contact.view.filter(|_| contact.oriented).zip(source.normals);
    let sighted =
        sighted.map(|(view, normals)| Sighted::new(&view, normals, target_from_source, contact.distance));
    let (mut visible, mut moved) = (Vec::with_capacity(rows.len()), Vec::with_capacity(rows.len()));
    for i in rows {
        let point = rotation * source.points[i] + shift;
        let sight = sighted.as_ref().map_or(Sight::Open, |sighted| sighted.sight(i, &rotation, &point));
        if sight != Sight::Hidden {
            visible.push((i, sight));
            moved.push(point);
        }
    }
    let nearest = nearby.nearest_each(contact.distance, &moved);
    for ((&(i, sight), moved), row) in visible.iter().zip(&moved).zip(nearest) {
        match row.and_then(|row| contact.gap(target, row, moved, source.normals.map(|n| rotation * n[i]))) {
            Some((row, gap)) => found(i, Place::On(row), gap),
            // Where the surface ends the camera sees past it.
            None if sight == Sight::Through => found(i, Place::Through, Vector3::zeros()),
            None => found(i, Place::Free, Vector3::zeros()),
        }
    }
}

/// The cameras' view of the source in one pose.
struct Sighted<'a> {
    /// With which source points are behind other ones.
    eyes: Vec<(&'a Eye, &'a [bool])>,
    normals: &'a [Vector3<f64>],
    tolerance: f64,
}

/// Least cosine between the normal of a point and the direction to the camera: what is seen from its edge is measured
/// badly or not at all.
pub const MIN_FACING_COS: f64 = 0.15;

impl<'a> Sighted<'a> {
    fn new(
        view: &View<'a>,
        normals: &'a [Vector3<f64>],
        target_from_source: &Isometry3<f64>,
        tolerance: f64,
    ) -> Self {
        let middle = view.own.map_or_else(Point3::origin, |own| *own.middle());
        let with_shadow =
            |eye: &'a Eye| (eye, view.own.map_or(&[][..], |own| own.from(&eye.place, target_from_source)));
        // Of a camera that went about the nearest place sees enough to tell poses from each other.
        let asked = asked(view.eyes, |eye| &eye.place, &(target_from_source * middle), 1);
        let eyes = asked.into_iter().map(with_shadow).collect();
        Self { eyes, normals, tolerance }
    }

    fn sight(&self, i: usize, rotation: &Rotation3<f64>, moved: &Point3<f64>) -> Sight {
        let normal = rotation * self.normals[i];
        let mut of_all = Sight::Hidden;
        for (eye, is_hidden) in &self.eyes {
            let to_eye = eye.place - moved;
            if normal.dot(&to_eye) <= MIN_FACING_COS * to_eye.norm() || is_hidden.get(i) == Some(&true) {
                continue;
            }
            match eye.measured.as_ref().map_or(Sight::Open, |seen| seen.sight(moved, self.tolerance)) {
                Sight::Open => return Sight::Open,
                Sight::Through => of_all = Sight::Through,
                Sight::Hidden => {}
            }
        }
        of_all
    }
}

/// Rows of the source points that a camera may see once the pose has moved them, at most `limit` of them, evenly taken.
#[must_use]
pub fn visible(
    source: &Surface<'_>,
    view: &View<'_>,
    target_from_source: &Isometry3<f64>,
    tolerance: f64,
    limit: usize,
) -> Vec<u32> {
    let all = 0..source.points.len() as u32;
    let Some(normals) = source.normals else { return all.collect() };
    let sighted = Sighted::new(view, normals, target_from_source, tolerance);
    let rotation = target_from_source.rotation.to_rotation_matrix();
    let shift = target_from_source.translation.vector;
    let is_visible = |&row: &u32| {
        let moved = rotation * source.points[row as usize] + shift;
        sighted.sight(row as usize, &rotation, &moved) != Sight::Hidden
    };
    let rows: Vec<u32> = all.filter(is_visible).collect();
    let step = rows.len().div_ceil(limit).max(1);
    rows.into_iter().step_by(step).collect()
}

/// Share of the visible source points that lie on the target; 0 if none is visible.
///
/// # Complexity
/// As [`places`], of which it takes a part of the time where no normals count.
#[must_use]
pub fn overlap(
    source: &Surface<'_>,
    target: &Surface<'_>,
    nearby: &Nearby,
    target_from_source: &Isometry3<f64>,
    contact: &Contact<'_>,
) -> f64 {
    // Points with normals may be hidden or turned away; of others it is enough that some target point is near.
    if source.normals.is_some() {
        return overlap_of(&places(source, target, nearby, target_from_source, contact));
    }
    let rotation = target_from_source.rotation.to_rotation_matrix();
    let shift = target_from_source.translation.vector;
    let chunks = par::chunks(source.points.len(), GRAIN, |rows| {
        let moved: Vec<_> = source.points[rows].iter().map(|p| rotation * p + shift).collect();
        nearby.any_within_each(contact.distance, &moved).into_iter().filter(|&is_on| is_on).count()
    });
    chunks.iter().sum::<usize>() as f64 / source.points.len().max(1) as f64
}

/// Share of the visible ones of `places` that are on the target; 0 if none is visible.
#[must_use]
pub fn overlap_of(places: &[Place]) -> f64 {
    let visible = places.iter().filter(|&&place| place != Place::Hidden).count();
    let on = places.iter().filter(|place| matches!(place, Place::On(_))).count();
    on as f64 / visible.max(1) as f64
}
