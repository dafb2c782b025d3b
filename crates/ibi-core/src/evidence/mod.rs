//! What speaks for a pose and what against it.
//!
//! Inputs are clouds, eyes and tolerances in data units; nothing here knows of stages or parameters. In the rounds a pose is judged
//! on the thinned clouds: by the correspondences that agree (`witnesses`), what is claimed (`claims`, `ledger`), what chance would
//! bring (`chance`), which `support` turns into odds. Before it becomes an instance it is looked at close up (`closeup`), on all that
//! was measured: each of its points is *supported* (a surface was measured there), *contradicted* (an eye looked through it), or says
//! nothing, as it is hidden, turned away or nothing was measured.
//!
//! | measure | asks |
//! |---|---|
//! | [`seen`] | is each point of the model where something was measured, or was it seen through? |
//! | [`contour`] | does the scene go on where the part should end? |
//! | [`slip`] | how far do the data pin the pose down, and along which motions do they not? |
//! | [`settle`] | is there a better pose close by, along those motions? |
//! | [`noise`] | what is the unit of all that: how far do measured points lie off their surface? |
//! | [`polish`] | at the end: where do all measured points that a pose explains want it to be? |
//! | [`shared`] | how many of them err alike? |
//!
//! [`odds`] weighs them. [`rays`] holds what one eye measured, and [`explained`] tells which points of it are a pose's: what poses of
//! different models compete for.

mod chance;
mod claims;
mod closeup;
pub mod contour;
pub mod explained;
mod fine;
mod ledger;
pub mod noise;
pub mod odds;
pub mod polish;
pub mod rays;
pub mod seen;
pub mod settle;
pub mod shared;
pub mod slip;
mod support;
mod witnesses;

pub(crate) use chance::Chance;
pub(crate) use claims::are_near;
pub use claims::{Claims, NearClaims};
pub(crate) use closeup::{Closeup, Proof};
pub use contour::{Contour, Overrun};
pub(crate) use fine::{Fine, Fitted, Known};
pub(crate) use ledger::Ledger;
pub use odds::{Measures, Objection};
pub use seen::Tally;
pub(crate) use shared::{Correlation, Pairs};
pub use slip::FreeMotion;
pub use support::Support;
pub(crate) use witnesses::{LOOK_NEAR, Witnesses};
