//! Values outside the validated ranges: each is reported, and none at the ends of the ranges.

use std::path::Path;

use scene::Scene;
use simulation::{Verdict, findings};
use test_support::scenes::TOOL;

/// Key, the range without a finding, and values outside it that a scene can set.
const RANGES: [(&str, [f64; 2], &[f64]); 6] = [
    ("manipulator.stiffness_scale", [0.05, 1000.0], &[0.049]),
    ("manipulator.mass_scale", [0.01, 100.0], &[0.0099, 101.0]),
    ("manipulator.damping_ratio", [0.005, 5.0], &[0.0049, 5.1]),
    ("manipulator.lateral_stiffness_ratio", [0.1, 300.0], &[0.099, 301.0]),
    ("manipulator.torsion_stiffness_ratio", [0.1, 300.0], &[0.099, 301.0]),
    ("contact.stiffness_n_per_m", [1e4, 1e8], &[9.9e3, 1.1e8]),
];

fn said(key: &str, value: f64) -> Vec<String> {
    let (table, name) = key.rsplit_once('.').unwrap();
    let text = format!(
        "name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[{table}]\n{name} = {value:?}\n{TOOL}"
    );
    let scene = Scene::parse(&text, Path::new("a.toml")).unwrap();
    let found = findings(&scene, None, &|_| true).unwrap();
    assert!(found.iter().all(|finding| finding.verdict == Verdict::Unlikely), "{found:?}");
    found.iter().map(|finding| finding.problem.clone()).collect()
}

#[test]
fn a_value_for_which_nothing_is_claimed_is_told_and_one_at_the_end_of_the_range_is_not() {
    for (key, inside, outside) in RANGES {
        for key in [key.to_owned(), format!("truth.{key}")] {
            for value in inside {
                assert_eq!(said(&key, value), Vec::<String>::new(), "{key} = {value}");
            }
            for value in outside {
                let said = said(&key, *value);
                let expected = format!("is {value}; expected {} to {}: ", inside[0], inside[1]);
                assert_eq!(said.len(), 1, "{key} = {value}: {said:?}");
                assert!(said[0].starts_with(&expected), "{}", said[0]);
            }
        }
    }
}
