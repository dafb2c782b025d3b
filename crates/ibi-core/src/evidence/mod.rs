//! What speaks for a pose: the correspondences and scene points that agree with it, what chance would bring, and what
//! others have claimed. Inputs are clouds and tolerances in data units; nothing here knows of stages or parameters.

mod chance;
mod claims;
mod ledger;
mod support;
mod witnesses;

pub(crate) use chance::Chance;
pub(crate) use claims::are_near;
pub use claims::{Claims, NearClaims};
pub(crate) use ledger::Ledger;
pub use support::Support;
pub(crate) use witnesses::{LOOK_NEAR, Witnesses};
