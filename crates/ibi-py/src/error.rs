//! The errors of the core as exceptions of Python.

use ibi_core::detection::DetectionError;
use ibi_core::features::FeatureError;
use ibi_core::metrics::MetricsError;
use ibi_core::{Error, SymmetryError};
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

/// An error that Python has a word for. Of an interruption nobody sees it: the signal is raised first.
pub(crate) trait ToPyErr: ToString {
    fn to_py_err(&self) -> PyErr {
        InputError::new_err(self.to_string())
    }
}

impl ToPyErr for Error {
    fn to_py_err(&self) -> PyErr {
        let message = self.to_string();
        match self {
            Self::Param { .. } => ParamsError::new_err(message),
            Self::ThreadPool { .. } => PyRuntimeError::new_err(message),
            _ => InputError::new_err(message),
        }
    }
}

impl ToPyErr for FeatureError {}

impl ToPyErr for SymmetryError {}

impl ToPyErr for DetectionError {
    fn to_py_err(&self) -> PyErr {
        match self {
            Self::Input(error) => error.to_py_err(),
            _ => InputError::new_err(self.to_string()),
        }
    }
}

impl ToPyErr for MetricsError {
    fn to_py_err(&self) -> PyErr {
        PyValueError::new_err(self.to_string())
    }
}

/// Results with an error that Python has a word for.
pub(crate) trait OrPyErr<T> {
    fn or_py_err(self) -> PyResult<T>;
}

impl<T, E: ToPyErr> OrPyErr<T> for Result<T, E> {
    fn or_py_err(self) -> PyResult<T> {
        self.map_err(|error| error.to_py_err())
    }
}
