//! Parameters as plain data: round trips, and how an option says that it has no value.

use ibi_core::Params;
use serde::Deserialize;
use serde::de::IntoDeserializer;
use serde::de::value::{Error, MapDeserializer};
use serde_json::{Value, json};

/// The parameters that may have no value, and a value for each.
fn options() -> Vec<(&'static str, Value)> {
    vec![
        ("resolution", json!(0.25)),
        ("min_normal_cos", json!(0.75)),
        ("max_rejections", json!(7)),
        ("max_rounds", json!(8)),
        ("max_instances", json!(9)),
        ("timeout_s", json!(1.5)),
    ]
}

fn presets() -> [Params; 5] {
    [
        Params::default(),
        Params::paper_synthetic(),
        Params::paper_real(),
        Params::single_view(),
        Params::many_views(),
    ]
}

fn to_json(params: &Params) -> Value {
    serde_json::to_value(params).unwrap()
}

/// The default but for one entry, read from JSON.
fn read(name: &str, value: &Value) -> Result<Params, String> {
    serde_json::from_value(json!({ name: value })).map_err(|error| error.to_string())
}

/// What [`read`] should make of it.
fn expected(name: &str, value: Value) -> Value {
    let mut all = to_json(&Params::default());
    all[name] = value;
    all
}

/// The same from a format that has no null, as TOML.
fn read_plain<'de, V: IntoDeserializer<'de, Error>>(name: &'de str, value: V) -> Result<Params, Error> {
    Params::deserialize(MapDeserializer::new([(name, value)].into_iter()))
}

#[test]
fn presets_survive_a_round_trip() {
    for preset in presets() {
        let text = serde_json::to_string(&preset).unwrap();
        assert_eq!(serde_json::from_str::<Params>(&text).unwrap(), preset);
    }
    // What is left out takes its default.
    assert_eq!(serde_json::from_str::<Params>("{}").unwrap(), Params::default());
}

#[test]
fn every_option_reads_none_null_and_a_value() {
    for (name, value) in options() {
        for nothing in [json!("none"), Value::Null] {
            let params = read(name, &nothing).unwrap();
            assert_eq!(to_json(&params), expected(name, Value::Null), "{name}");
            // And says so when it is written.
            let text = serde_json::to_string(&params).unwrap();
            assert_eq!(serde_json::from_str::<Params>(&text).unwrap(), params, "{name}");
        }
        assert_eq!(to_json(&read_plain(name, "none").unwrap()), expected(name, Value::Null), "{name}");
        let params = read(name, &value).unwrap();
        assert_eq!(to_json(&params), expected(name, value), "{name}");
        assert_eq!(serde_json::from_value::<Params>(to_json(&params)).unwrap(), params, "{name}");
        // Whole numbers are numbers too, whatever their type.
        let one = expected(name, if name.starts_with("max_") { json!(1) } else { json!(1.0) });
        assert_eq!(to_json(&read(name, &json!(1)).unwrap()), one, "{name}");
        assert_eq!(to_json(&read_plain(name, 1_i64).unwrap()), one, "{name}");
    }
}

#[test]
fn nothing_else_is_none() {
    for (name, _) in options() {
        for wrong in [json!("None"), json!(""), json!("nil"), json!(true), json!([]), json!({})] {
            let error = read(name, &wrong).expect_err(name);
            assert!(error.contains("a number or \"none\""), "{name} {wrong}: {error}");
        }
        assert!(read_plain(name, "off").is_err(), "{name}");
    }
    for name in ["max_rejections", "max_rounds", "max_instances"] {
        for wrong in [json!(-1), json!(1.5), json!(4_294_967_296_u64)] {
            assert!(read(name, &wrong).is_err(), "{name}");
        }
    }
    // Those that must have a value take no word for it.
    let all = to_json(&Params::default());
    let names: Vec<&String> = all.as_object().unwrap().keys().collect();
    assert!(options().iter().all(|(name, _)| names.iter().any(|other| other == name)));
    for name in names.into_iter().filter(|name| !options().iter().any(|(option, _)| option == name)) {
        assert!(read(name, &Value::Null).is_err(), "{name}");
        // Refinement has a variant of that name.
        assert_eq!(read(name, &json!("none")).is_ok(), name == "refine", "{name}");
    }
}
