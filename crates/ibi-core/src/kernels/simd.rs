//! Vector units, chosen at run time. The only file that names `pulp`.
//!
//! A wheel must run on every machine of its architecture, so the crate is compiled for the oldest one. A loop inside
//! [`simd`] is compiled a second and a third time for newer vector units (AVX2, AVX-512), and the best copy that the
//! processor has is taken. Nothing is computed in another order or fused, so the bits stay the same.
//!
//! Where the compiler does not see the vectors by itself, a loop is written with those of [`Simd`], as the
//! [`WithSimd`] of a type, and run by [`dispatch`].

use std::sync::LazyLock;

pub(crate) use pulp::{Simd, WithSimd, bytemuck};

static ARCH: LazyLock<pulp::Arch> = LazyLock::new(pulp::Arch::new);

/// Runs `job` with the widest vector units at hand. Only what is inlined into `job` gains by it.
#[inline(always)]
#[allow(clippy::inline_always)] // `job` must be seen through
pub(crate) fn simd<T>(job: impl FnOnce() -> T) -> T {
    ARCH.dispatch(job)
}

/// Runs `job` with the widest vector units at hand, which it is told.
#[inline(always)]
#[allow(clippy::inline_always)]
pub(crate) fn dispatch<J: WithSimd>(job: J) -> J::Output {
    ARCH.dispatch(job)
}
