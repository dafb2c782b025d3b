//! The ranges that parameters are held against, and how options are read.

use crate::error::Error;

/// Lengths below or above this many data units, or pr, are mistakes, and their squares leave the floats.
const LENGTHS: std::ops::RangeInclusive<f64> = 1e-9..=1e9;

/// Reads an option, in which the word `none` stands for no value: TOML cannot say it otherwise.
#[cfg(feature = "serde")]
pub(crate) fn none_or<'de, D, T>(deserializer: D) -> Result<Option<T>, D::Error>
where
    D: serde::Deserializer<'de>,
    T: serde::Deserialize<'de>,
{
    #[derive(serde::Deserialize)]
    #[serde(untagged, expecting = "a number or \"none\"")]
    enum Given<T> {
        Value(T),
        Word(Word),
        Null(()),
    }
    #[derive(serde::Deserialize)]
    #[serde(rename_all = "snake_case")]
    enum Word {
        None,
    }
    Ok(match serde::Deserialize::deserialize(deserializer)? {
        Given::Value(value) => Some(value),
        Given::Word(Word::None) | Given::Null(()) => None,
    })
}

pub(crate) fn check(name: &'static str, value: f64, fine: bool, allowed: &'static str) -> Result<(), Error> {
    if fine { Ok(()) } else { Err(Error::Param { name, value, allowed }) }
}

pub(crate) fn positive(name: &'static str, value: f64) -> Result<(), Error> {
    check(name, value, LENGTHS.contains(&value), "between 1e-9 and 1e9")
}

pub(crate) fn non_negative(name: &'static str, value: f64) -> Result<(), Error> {
    check(name, value, value == 0.0 || LENGTHS.contains(&value), "0 or between 1e-9 and 1e9")
}

pub(crate) fn at_least_1(name: &'static str, value: u32) -> Result<(), Error> {
    check(name, value.into(), value >= 1, "at least 1")
}

pub(crate) fn at_least_3(name: &'static str, value: u32) -> Result<(), Error> {
    check(name, value.into(), value >= 3, "at least 3")
}

pub(crate) fn at_least_8(name: &'static str, value: u32) -> Result<(), Error> {
    check(name, value.into(), value >= 8, "at least 8")
}

pub(crate) fn at_most(name: &'static str, value: u32, max: u32, allowed: &'static str) -> Result<(), Error> {
    check(name, value.into(), value <= max, allowed)
}

pub(crate) fn share(name: &'static str, value: f64) -> Result<(), Error> {
    check(name, value, (0.0..=1.0).contains(&value), "between 0 and 1")
}
