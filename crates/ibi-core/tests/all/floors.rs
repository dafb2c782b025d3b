//! Whether the house stands: each file imports only from the floors below its own, as the map in CONTRIBUTING.md has them.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// The floor of each room of `src`, 0 the lowest, from the table between the marks in CONTRIBUTING.md.
fn floors(map: &str) -> BTreeMap<String, usize> {
    let rows = map.split("<!-- floors -->").nth(1).expect("the marks of the table").lines();
    let rows: Vec<&str> = rows.filter(|row| row.starts_with("| `")).collect();
    let rooms = |row: &&str| -> Vec<String> {
        let cell = row.split('|').nth(1).unwrap_or_default();
        cell.split('`').skip(1).step_by(2).map(str::to_owned).collect()
    };
    let floors = rows.iter().rev().enumerate();
    floors.flat_map(|(floor, row)| rooms(row).into_iter().map(move |room| (room, floor))).collect()
}

/// All files of a folder and of those in it, with their path from `src`.
fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<PathBuf> =
        entries.flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] }).collect();
    files.sort();
    files
}

/// The rooms that a file's code names, tests and comments left out.
fn named(text: &str) -> Vec<String> {
    let code = text.split("\nmod tests {").next().unwrap_or_default();
    let code: Vec<&str> = code.lines().map(|line| line.split("//").next().unwrap_or_default()).collect();
    let code = code.join("\n");
    let name =
        |rest: &str| -> String { rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect() };
    code.split("crate::").skip(1).map(name).collect()
}

/// The imports of `of` that do not lead down, and rooms that the map does not know.
fn climbing(floors: &BTreeMap<String, usize>, of: &str, text: &str) -> Vec<String> {
    let Some(own) = floors.get(of) else { return vec![format!("{of} is on no floor")] };
    let is_down = |name: &String| name == of || floors.get(name).is_some_and(|floor| floor < own);
    named(text)
        .into_iter()
        .filter(|name| !is_down(name))
        .map(|name| format!("{of} climbs to {name}"))
        .collect()
}

fn map() -> BTreeMap<String, usize> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../CONTRIBUTING.md");
    floors(&fs::read_to_string(path).unwrap())
}

#[test]
fn no_file_imports_upward() {
    let (floors, src) = (map(), Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/src")));
    let mut climbs = Vec::new();
    for file in files(src) {
        let inner = file.strip_prefix(src).unwrap();
        let room = inner.iter().next().unwrap().to_str().unwrap().trim_end_matches(".rs");
        if room != "lib" {
            let found = climbing(&floors, room, &fs::read_to_string(&file).unwrap());
            climbs.extend(found.into_iter().map(|climb| format!("{}: {climb}", inner.display())));
        }
    }
    assert!(climbs.is_empty(), "{climbs:#?}");
}

#[test]
fn an_import_that_climbs_is_found() {
    let floors = map();
    let climbs = |of, text| climbing(&floors, of, text);
    assert!(climbs("scene", "use crate::kernels::rng::Rng; // crate::rounds\n").is_empty());
    assert_eq!(climbs("scene", "use crate::params::Params;"), ["scene climbs to params"]);
    assert_eq!(climbs("kernels", "fn f() -> Result<(), crate::Error>"), ["kernels climbs to Error"]);
    assert_eq!(climbs("shed", ""), ["shed is on no floor"]);
    assert!(climbs("scene", "#[cfg(test)]\nmod tests { use crate::params::Params; }").is_empty());
}
