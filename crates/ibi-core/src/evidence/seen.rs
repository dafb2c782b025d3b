//! Whether what a pose puts before an eye was measured there, was looked through, or cannot be told.

use nalgebra::{Point3, Vector3};

use super::rays::{Rays, faces};

/// What an eye says of a point on a surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Seen {
    /// The surface is turned away from it, or the model itself is in the way: nothing is asked.
    Away,
    /// Nothing was measured in that direction, or both sides of an edge.
    Unknown,
    /// Something else was measured in front of it.
    Hidden,
    /// What was measured is in front of it, but so close that hardly anything could lie between: it is as if the surface were
    /// too deep.
    Buried,
    /// All that was measured there lies behind it: the eye looked through it.
    Contradicted,
    /// It was measured.
    Supported,
}

/// What counts as the same place, data units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tolerance {
    /// Across the surface.
    pub across: f64,
    /// Along it: how far off a ray may pass and still tell of a point. Rays are also taken as far as a few of them lie apart.
    pub aside: f64,
}

impl Tolerance {
    /// For a scene that was thinned to a `voxel`, with a standard deviation of the scan's `noise` across a surface.
    #[must_use]
    pub fn of(voxel: f64, noise: f64) -> Self {
        Self { across: (POSE_VOXELS * voxel).hypot(NOISES * noise), aside: ASIDE_VOXELS * voxel }
    }
}

/// How well a pose that was polished in voxels is known across and along a surface, in voxels, and how many standard deviations
/// of the noise a measured point may lie off.
const POSE_VOXELS: f64 = 0.4;
const ASIDE_VOXELS: f64 = 0.35;
const NOISES: f64 = 2.5;

/// Rays within so many spacings tell of a point: seven or so of a regular image.
const ASIDE_RAYS: f64 = 1.5;

/// What is less than so many tolerances behind what was measured is buried, and not hidden.
const BURIED: f64 = 3.0;

/// What was measured where a surface should be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Look {
    /// What that comes to.
    pub seen: Seen,
    /// How far in front of the surface it lies, across it, data units: the mean of what is within the tolerance, or, where nothing
    /// is, the nearest; 0 where nothing was measured.
    pub gap: f64,
    /// Of the rays that pass near, the share that ends within the tolerance.
    pub share: f64,
}

impl Look {
    /// Of what nothing was measured.
    #[must_use]
    pub fn of(seen: Seen) -> Self {
        Self { seen, gap: 0.0, share: 0.0 }
    }
}

/// Looks at a point on a surface with a unit normal.
///
/// Rays that pass near the point are held against its tangent plane. If one ends there it is supported. If all end in front it is
/// hidden, if all end behind it is contradicted; if some do this and some that, an edge is near and nothing is told. The mean over
/// the rays is far less noisy than one of them: it tells a wrong size from the right one where single points cannot.
#[must_use]
pub fn look(rays: &Rays, at: &Point3<f64>, normal: &Vector3<f64>, tolerance: Tolerance) -> Look {
    let to = at - rays.eye();
    let plane = normal.dot(&to);
    let angle = (ASIDE_RAYS * rays.spacing()).max(tolerance.aside / to.norm());
    let (mut behind, mut front, mut nearest) = (f64::INFINITY, f64::NEG_INFINITY, f64::INFINITY);
    let (mut sum, mut within, mut all) = (0.0, 0_u32, 0_u32);
    rays.each_near(at, angle, |end, _| {
        let gap = normal.dot(end) - plane;
        (behind, front) = (behind.min(gap), front.max(gap));
        if gap.abs() < nearest.abs() {
            nearest = gap;
        }
        if gap.abs() <= tolerance.across {
            (sum, within) = (sum + gap, within + 1);
        }
        all += 1;
    });
    if all == 0 {
        return Look::of(Seen::Unknown);
    }
    if within > 0 {
        let [within, all] = [within, all].map(f64::from);
        return Look { seen: Seen::Supported, gap: sum / within, share: within / all };
    }
    let seen = if front < 0.0 {
        Seen::Contradicted
    } else if behind < 0.0 {
        Seen::Unknown
    } else if behind < BURIED * tolerance.across {
        Seen::Buried
    } else {
        Seen::Hidden
    };
    Look { seen, gap: nearest, share: 0.0 }
}

/// What an eye says of each point of a model that a pose has moved. `is_hidden` tells which of them the model itself hides from
/// it; an empty one: none. One in `every` points is asked for, the others are [`Seen::Away`].
///
/// # Complexity
/// O(points), times the rays that pass near each.
#[must_use]
pub fn sight(
    rays: &Rays,
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    is_hidden: &[bool],
    every: usize,
    tolerance: Tolerance,
) -> Vec<Look> {
    let of = |(i, (at, normal)): (usize, (&Point3<f64>, &Vector3<f64>))| {
        let is_away = i % every != 0 || is_hidden.get(i) == Some(&true) || !faces(rays.eye(), at, normal);
        if is_away { Look::of(Seen::Away) } else { look(rays, at, normal, tolerance) }
    };
    points.iter().zip(normals).enumerate().map(of).collect()
}

/// What several eyes say of the same points, as if they were one: what one has measured is there, whatever was in the way of
/// others, and what one has looked through and none has measured is not.
pub fn merge(of_all: &mut [Look], of_another: &[Look]) {
    for (all, another) in of_all.iter_mut().zip(of_another) {
        let is_nearer = another.seen == Seen::Supported && another.gap.abs() < all.gap.abs();
        if another.seen > all.seen || (another.seen == all.seen && is_nearer) {
            *all = *another;
        }
    }
}

/// How many points are seen how.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[allow(missing_docs)]
pub struct Tally {
    pub away: u32,
    pub unknown: u32,
    pub hidden: u32,
    pub buried: u32,
    pub contradicted: u32,
    pub supported: u32,
}

impl Tally {
    /// Counts.
    #[must_use]
    pub fn of(sight: &[Look]) -> Self {
        let mut tally = Self::default();
        for look in sight {
            *match look.seen {
                Seen::Away => &mut tally.away,
                Seen::Unknown => &mut tally.unknown,
                Seen::Hidden => &mut tally.hidden,
                Seen::Buried => &mut tally.buried,
                Seen::Contradicted => &mut tally.contradicted,
                Seen::Supported => &mut tally.supported,
            } += 1;
        }
        tally
    }

    /// Those of which something is known.
    #[must_use]
    pub fn known(&self) -> u32 {
        self.buried + self.contradicted + self.supported
    }

    /// Those that were asked for.
    #[must_use]
    pub fn asked(&self) -> u32 {
        self.known() + self.hidden + self.unknown
    }
}
