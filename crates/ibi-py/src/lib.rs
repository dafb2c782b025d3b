//! The module `ibi_rs._core`: converts, detaches, maps errors. Everything a user reads is in `python/ibi_rs`.

mod features;
mod metrics;
mod params;
mod register;
mod runs;
mod stages;
mod symmetries;

use pyo3::create_exception;
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;

create_exception!(
    ibi_rs,
    InputError,
    PyValueError,
    "An array that cannot be used; the message says which and why."
);
create_exception!(ibi_rs, ParamsError, PyValueError, "A parameter that is unknown or out of range.");

/// The Python exception for an error of the core.
fn to_py_err(error: &ibi_core::Error) -> PyErr {
    let message = error.to_string();
    match error {
        ibi_core::Error::Param { .. } => ParamsError::new_err(message),
        ibi_core::Error::ThreadPool { .. } => PyRuntimeError::new_err(message),
        _ => InputError::new_err(message),
    }
}

#[pymodule]
fn _core(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add("__version__", env!("CARGO_PKG_VERSION"))?;
    m.add("InputError", m.py().get_type::<InputError>())?;
    m.add("ParamsError", m.py().get_type::<ParamsError>())?;
    params::register(m)?;
    runs::register(m)?;
    register::register(m)?;
    metrics::register(m)?;
    features::register(m)?;
    symmetries::register(m)
}
