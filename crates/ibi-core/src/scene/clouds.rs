//! Two clouds before they are a scene: whether they fit together, pr, and what lies near in each.

use super::cloud::PreparedCloud;
use super::tolerances::Tolerances;
use crate::error::{Argument, Error};
use crate::interrupt::Interrupt;
use crate::kernels::nearby::Nearby;

/// Both clouds, found to fit together, and pr.
pub(crate) struct Clouds<'a> {
    pub(crate) source: &'a PreparedCloud<'a>,
    pub(crate) target: PreparedCloud<'a>,
    pub(crate) resolution: f64,
}

impl<'a> Clouds<'a> {
    pub(crate) fn new(
        source: &'a PreparedCloud<'a>,
        target: PreparedCloud<'a>,
        resolution: Option<f64>,
    ) -> Result<Self, Error> {
        let (src, tgt) = (Argument::SrcNormals, Argument::TgtNormals);
        match (&source.normals, &target.normals) {
            (Some(_), None) => return Err(Error::NormalsOfOneCloud { given: src, missing: tgt }),
            (None, Some(_)) => return Err(Error::NormalsOfOneCloud { given: tgt, missing: src }),
            _ => {}
        }
        let (src, tgt) = (Argument::SrcFrames, Argument::TgtFrames);
        match (&source.frames, &target.frames) {
            (Some(_), None) => return Err(Error::FramesOfOneCloud { given: src, missing: tgt }),
            (None, Some(_)) => return Err(Error::FramesOfOneCloud { given: tgt, missing: src }),
            _ => {}
        }
        // Metres against millimetres would make pr so coarse that a whole cloud fits into one point, and any
        // pose overlaps perfectly. The test needs no factor: below it no registration makes sense.
        for (small, s, large, l) in
            [(Argument::Src, source, Argument::Tgt, &target), (Argument::Tgt, &target, Argument::Src, source)]
        {
            if s.extent < l.spacing {
                return Err(Error::DifferentUnits { small, extent: s.extent, large, spacing: l.spacing });
            }
        }
        let resolution = resolution.unwrap_or(0.5 * (source.spacing + target.spacing));
        if resolution <= 0.0 {
            // Below what numbers can hold.
            return Err(Error::NoExtent { argument: Argument::Src });
        }
        Ok(Self { source, target, resolution })
    }

    /// What lies near in each of them.
    pub(crate) fn near(&self, tolerances: &Tolerances, interrupt: &Interrupt) -> Result<[Nearby; 2], Error> {
        let usual = 2.0 * tolerances.d_op_pr * self.resolution;
        let reach = usual.max(tolerances.t_he_pr * self.resolution);
        let near = |points| Nearby::until(points, reach, usual, || interrupt.is_set());
        let near = near(&self.source.points).zip(near(&self.target.points));
        near.map(|(source, target)| [source, target]).ok_or_else(|| interrupt.error())
    }
}
