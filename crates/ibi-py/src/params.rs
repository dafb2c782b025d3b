//! Parameters cross the border as JSON text: one source of defaults, ranges and unknown keys, the core's.

use ibi_core::Params;
use pyo3::prelude::*;

use crate::error::{OrPyErr, ParamsError};

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(preset, m)?)?;
    m.add_function(wrap_pyfunction!(check_params, m)?)?;
    m.add_function(wrap_pyfunction!(params_to_toml, m)?)?;
    m.add_function(wrap_pyfunction!(params_from_toml, m)?)?;
    m.add_function(wrap_pyfunction!(toml_to_json, m)?)
}

/// Params from JSON, checked.
pub(crate) fn parse(json: &str) -> PyResult<Params> {
    let params: Params = serde_json::from_str(json).map_err(invalid)?;
    params.validate().or_py_err()?;
    Ok(params)
}

fn to_json(params: &Params) -> PyResult<String> {
    serde_json::to_string(params).map_err(invalid)
}

fn invalid(error: impl std::fmt::Display) -> PyErr {
    // toml's messages span lines and draw the place; the first line and the last say it all.
    let message = error.to_string();
    let first = message.lines().next().unwrap_or_default();
    let last = message.lines().last().unwrap_or_default();
    let both = if first == last { first.to_owned() } else { format!("{first}: {last}") };
    ParamsError::new_err(format!("params: {both}"))
}

#[pyfunction]
fn preset(name: &str) -> PyResult<String> {
    let params = match name {
        "default" => Params::default(),
        "paper_synthetic" => Params::paper_synthetic(),
        "paper_real" => Params::paper_real(),
        "single_view" => Params::single_view(),
        "many_views" => Params::many_views(),
        _ => return Err(ParamsError::new_err(format!("no preset is called {name:?}"))),
    };
    to_json(&params)
}

/// Checks JSON and returns it complete, with the defaults of what it leaves out.
#[pyfunction]
fn check_params(json: &str) -> PyResult<String> {
    to_json(&parse(json)?)
}

#[pyfunction]
fn params_to_toml(json: &str) -> PyResult<String> {
    let mut plain = serde_json::to_value(parse(json)?).map_err(invalid)?;
    nulls_to_none(&mut plain);
    toml::to_string(&plain).map_err(invalid)
}

/// TOML has no null, and what it leaves out takes its default, which need not be none.
fn nulls_to_none(value: &mut serde_json::Value) {
    if value.is_null() {
        *value = "none".into();
    }
    value.as_object_mut().into_iter().flat_map(|inner| inner.values_mut()).for_each(nulls_to_none);
}

#[pyfunction]
fn params_from_toml(text: &str) -> PyResult<String> {
    let params: Params = toml::from_str(&with_blocks(text)).map_err(invalid)?;
    params.validate().or_py_err()?;
    to_json(&params)
}

/// Rewrites the text of a parameter file, of which nothing is checked and to which nothing is added.
#[pyfunction]
fn toml_to_json(text: &str) -> PyResult<String> {
    let plain: serde_json::Value = toml::from_str(text).map_err(invalid)?;
    serde_json::to_string(&plain).map_err(invalid)
}

/// Makes `scs = "gtm"` a block, as `Params(scs="gtm")` does. In the text, so that errors keep their lines.
fn with_blocks(text: &str) -> String {
    let mut text = text.to_owned();
    for stage in ["scs", "ce", "te", "hv"] {
        let word = toml::de::DeTable::parse(&text).ok().and_then(|table| {
            let value = table.get_ref().get(stage)?;
            value.get_ref().is_str().then(|| value.span())
        });
        if let Some(span) = word {
            let block = format!("{{ variant = {} }}", &text[span.clone()]);
            text.replace_range(span, &block);
        }
    }
    text
}
