//! Parameters from text: what can be read and is in range survives a round trip through JSON and TOML.
#![no_main]

use ibi_core::Params;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    let json: Option<Params> = serde_json::from_str(text).ok();
    let toml: Option<Params> = toml::from_str(text).ok();
    for params in json.into_iter().chain(toml) {
        if params.validate().is_err() {
            continue;
        }
        let text = serde_json::to_string(&params).expect("plain data");
        let back: Params = serde_json::from_str(&text).expect("what was written is read");
        assert_eq!(back, params);
    }
});
