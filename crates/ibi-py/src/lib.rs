//! The module `ibi_rs._core`: converts, detaches, maps errors. Everything a user reads is in `python/ibi_rs`.
//!
//! A file imports only from the lines above its own:
//!
//! | file | what |
//! |---|---|
//! | `error` | exceptions |
//! | `convert` | arrays in and out |
//! | `runs`, then `background` | the runs in flight; work without the GIL, where Ctrl-C is heard |
//! | `params`, `symmetries`, `features`, `metrics`, `stages` | what Python calls, a file for each module of the core |
//! | `model` | a part, prepared |
//! | `register`, then `detect` | arrays in, poses out |

mod background;
mod convert;
mod detect;
mod error;
mod features;
mod metrics;
mod model;
mod params;
mod register;
mod runs;
mod stages;
mod symmetries;

use pyo3::prelude::*;

use crate::error::{InputError, ParamsError};

#[pymodule]
fn _core(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add("__version__", env!("CARGO_PKG_VERSION"))?;
    m.add("InputError", m.py().get_type::<InputError>())?;
    m.add("ParamsError", m.py().get_type::<ParamsError>())?;
    params::register(m)?;
    runs::register(m)?;
    model::register(m)?;
    register::register(m)?;
    detect::register(m)?;
    metrics::register(m)?;
    features::register(m)?;
    symmetries::register(m)
}
