//! What the tests of `ibi-core` and its benches share: [`scenes`] whose truth is known, [`naive`] twins of the
//! kernels that are too simple to be wrong, and proptest [`strategies`].
//!
//! Does not depend on `ibi-core`, so that no oracle can lean on the code it judges.

pub mod evidence;
pub mod features;
pub mod naive;
mod rng;
pub mod scenes;
pub mod shapes;
pub mod strategies;

pub use rng::Rng;
