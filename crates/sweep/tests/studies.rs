//! Studies: rejected input, distribution of points, and indices against closed forms and SALib.

#![allow(clippy::unwrap_used, reason = "a failed test says so")]

use std::path::Path;
use std::process::Command;

use proptest::prelude::*;
use sweep::{Study, StudyError, indices};
use test_support::limited::Limited;

fn study(text: &str) -> Result<Study, StudyError> {
    Study::parse(text, Path::new("sweep.toml"), None)
}

fn of_ranges(design: &str, samples: u64, seed: u64, dimensions: usize) -> Study {
    let parameter = |i| format!("[[parameter]]\nkey = \"k{i}\"\nmin = 0.0\nmax = 1.0\n");
    let parameters: String = (0..dimensions).map(parameter).collect();
    study(&format!("design = \"{design}\"\nsamples = {samples}\nseed = {seed}\n{parameters}")).unwrap()
}

fn numbers(study: &Study, index: u64) -> Vec<f64> {
    study.point(index).values.iter().map(|(_, value)| value.as_float().unwrap()).collect()
}

proptest! {
    /// One sample per stratum of every parameter's range.
    #[test]
    fn a_latin_hypercube_has_one_sample_in_each_part(samples in 1_u64..200, seed in 0_u64..(1 << 62), dimensions in 1_usize..5) {
        let study = of_ranges("latin_hypercube", samples, seed, dimensions);
        for dimension in 0..dimensions {
            let part = |i| (numbers(&study, i)[dimension] * samples as f64) as u64;
            let mut parts: Vec<u64> = (0..samples).map(part).collect();
            parts.sort_unstable();
            prop_assert_eq!(parts, (0..samples).collect::<Vec<u64>>());
        }
    }

    /// Any 2^k consecutive points of a Sobol sequence, starting at a multiple of 2^k, have one in each of 2^k
    /// strata.
    #[test]
    fn a_sobol_sequence_is_even_at_every_power_of_two(k in 1_u32..9, seed in 0_u64..(1 << 62)) {
        let n = 1_u64 << k;
        let study = of_ranges("sobol", n, seed, 6);
        for dimension in 0..6 {
            let mut parts: Vec<u64> = (0..n).map(|i| (numbers(&study, i)[dimension] * n as f64) as u64).collect();
            parts.sort_unstable();
            prop_assert_eq!(parts, (0..n).collect::<Vec<u64>>());
        }
    }

    #[test]
    fn no_text_makes_a_study_panic(text in "\\PC{0,200}", table in "\\PC{0,100}") {
        let _ = Study::parse(&text, Path::new("s.toml"), Some(&table));
        let _ = Study::parse("design = \"csv\"\npoints = \"p.csv\"", Path::new("s.toml"), Some(&table));
    }
}

/// Points depend only on the study's text and the index, so these numbers must not change with machine or
/// version.
#[test]
fn the_points_of_a_study_never_change() {
    let found: Vec<String> = ["random", "latin_hypercube", "sobol", "saltelli"]
        .iter()
        .map(|design| format!("{design} {:?}", numbers(&of_ranges(design, 16, 5, 2), 11)))
        .collect();
    assert_eq!(found, POINTS);
}

const POINTS: [&str; 4] = [
    "random [0.5294615796715479, 0.575255327378392]",
    "latin_hypercube [0.7830913487294717, 0.22345345796114952]",
    "sobol [0.41187584400177, 0.2137899398803711]",
    "saltelli [0.39257967472076416, 0.5626634359359741]",
];

#[test]
fn a_grid_holds_every_combination_once() {
    let text = "design = \"grid\"\n[[parameter]]\nkey = \"a\"\nmin = 1.0\nmax = 100.0\nscale = \"log\"\nsteps = 3\n\
                [[parameter]]\nkey = \"b\"\nvalues = [\"x\", true]\n[[parameter]]\nkey = \"c\"\nmin = \
                1\nmax = 4\ninteger = true\nsteps = 4\n";
    let study = study(text).unwrap();
    assert_eq!(study.count(), 24);
    let all: Vec<String> = (0..24).map(|i| study.point(i).settings().join(" ")).collect();
    assert_eq!(all[0], "a=1.0 b=\"x\" c=1");
    assert_eq!(all[23], "a=100.0 b=true c=4");
    let distinct: std::collections::BTreeSet<&String> = all.iter().collect();
    assert_eq!(distinct.len(), 24);
}

#[test]
fn a_table_gives_its_rows() {
    let table = "run.seed,manipulator.model,tool.burr_start_mm\n1,\"planar\",[0.0, 1.0, 2.0]\n\n2,\"full\",[0.0, 1.5, 2.0]\n";
    let text = "design = \"csv\"\npoints = \"points.csv\"";
    let study = Study::parse(text, Path::new("s.toml"), Some(table)).unwrap();
    assert_eq!(study.count(), 2);
    let settings = study.point(1).settings();
    assert_eq!(settings, ["run.seed=2", "manipulator.model=\"full\"", "tool.burr_start_mm=[0.0, 1.5, 2.0]"]);
    let of_windows = Study::parse(text, Path::new("s.toml"), Some("run.seed\r\n1\r\n")).unwrap();
    assert_eq!(of_windows.point(0).settings(), ["run.seed=1"]);
    for (table, said) in [
        ("a\n1.0\nnan\n", "line 3: contains a non-finite number"),
        ("a,b\n1\n", "line 2: 1 values, but the first line has 2 keys"),
        ("a\nplanar\n", "line 2: not a list of TOML values"),
        ("a\n", "keys without any points"),
        ("", "is empty"),
        ("a,a\n1,2\n", "`a` is a duplicate key"),
    ] {
        let error = Study::parse(text, Path::new("s.toml"), Some(table)).unwrap_err().to_string();
        assert!(error.contains(said), "{table:?}: {error}");
    }
}

#[test]
fn a_bad_study_is_refused_with_file_key_value_and_range() {
    let range = "[[parameter]]\nkey = \"a\"\nmin = 0.0\nmax = 1.0\n";
    for (text, said) in [
        ("design = \"sobl\"", "line 1"),
        ("design = \"sobol\"\nsampels = 3", "line 2"),
        (&format!("design = \"sobol\"\nsamples = 0\n{range}"), "`samples` is 0, expected 1 to 65536"),
        (&format!("design = \"sobol\"\nsamples = 65537\n{range}"), "expected 1 to 65536"),
        (&format!("design = \"random\"\nsamples = 1000001\n{range}"), "expected 1 to 1000000"),
        (&format!("design = \"random\"\n{range}"), "`samples`"),
        ("design = \"random\"\nsamples = 2", "`parameter` is missing"),
        ("design = \"csv\"", "`points`"),
        (&format!("design = \"grid\"\n{range}"), "`parameter.0.steps` is missing"),
        (&format!("design = \"random\"\nsamples = 2\n{range}{range}"), "`a` is a duplicate key"),
        (
            &format!("design = \"random\"\nsamples = 2\n{}", range.replace("1.0", "nan")),
            "`parameter.0.max` is NaN",
        ),
        (
            &format!("design = \"random\"\nsamples = 2\n{}", range.replace("0.0", "nan")),
            "`parameter.0.min` is NaN",
        ),
        // The difference was infinite, and each sample the maximum.
        (
            &format!(
                "design = \"random\"\nsamples = 2\n{}",
                range.replace("0.0", "-1e308").replace("1.0", "1e308")
            ),
            "finitely far from `min`, which is -1e308",
        ),
        (
            &format!("design = \"random\"\nsamples = 2\n{}", range.replace("1.0", "-1.0")),
            "above `min`, which is 0.0",
        ),
        (
            &format!("design = \"random\"\nsamples = 2\n{range}scale = \"log\""),
            "above 0, because `scale` is \"log\"",
        ),
        (
            &format!("design = \"random\"\nsamples = 2\n{}", range.replace("\"a\"", "\"a b\"")),
            "`parameter.0.key` is `a b`",
        ),
        (
            &format!("design = \"random\"\nsamples = 2\n{}integer = true", range.replace("1.0", "1.5")),
            "whole numbers",
        ),
        ("design = \"random\"\nsamples = 2\n[[parameter]]\nkey = \"a\"\nvalues = []", "1 to 10000 values"),
        ("design = \"random\"\nsamples = 2\n[[parameter]]\nkey = \"a\"\nvalues = [inf]", "finite numbers"),
        (
            "design = \"random\"\nsamples = 2\n[[parameter]]\nkey = \"a\"",
            "expected `min` and `max`, or `values`",
        ),
        (
            &format!(
                "design = \"grid\"\n{0}steps = 10000\n{1}steps = 10000",
                range,
                range.replace("\"a\"", "\"b\"")
            ),
            "at most 1000000",
        ),
    ] {
        let error = study(text).unwrap_err().to_string();
        assert!(error.starts_with("sweep.toml") && error.contains(said), "{text}\n{error}");
    }
}

/// Ishigami and Homma 1990, with a = 7 and b = 0.1, on [-pi, pi] each.
fn ishigami(unit: &[f64]) -> f64 {
    let x: Vec<f64> = unit.iter().map(|u| std::f64::consts::PI * (2.0 * u - 1.0)).collect();
    x[0].sin() + 7.0 * x[1].sin().powi(2) + 0.1 * x[2].powi(4) * x[0].sin()
}

/// Closed form of its indices: V = a²/8 + b π⁴/5 + b² π⁸/18 + 1/2.
#[test]
fn sobol_indices_of_the_ishigami_function_are_those_of_its_closed_form() {
    let study = of_ranges("saltelli", 8192, 1, 3);
    let results: Vec<Option<f64>> = (0..study.count()).map(|i| Some(ishigami(&numbers(&study, i)))).collect();
    let (found, left_out) = indices(&results, 3).unwrap();
    let pi = std::f64::consts::PI;
    let (v1, v2, v13) = (
        0.5 * (1.0 + 0.1 * pi.powi(4) / 5.0).powi(2),
        49.0 / 8.0,
        0.01 * pi.powi(8) * (1.0 / 18.0 - 1.0 / 50.0),
    );
    let v = v1 + v2 + v13;
    assert_eq!(left_out, 0);
    for (index, [first, total]) in
        found.iter().zip([[v1 / v, (v1 + v13) / v], [v2 / v, v2 / v], [0.0, v13 / v]])
    {
        // With 8192 samples the estimators' own 95 % intervals are below 0.03.
        assert!((index.first_order - first).abs() < 0.03, "{index:?} {first}");
        assert!((index.total - total).abs() < 0.03, "{index:?} {total}");
        assert!(index.first_order_interval < 0.04 && index.total_interval < 0.04, "{index:?}");
    }
}

#[test]
fn samples_with_a_failed_run_are_left_out() {
    let study = of_ranges("saltelli", 64, 1, 3);
    let mut results: Vec<Option<f64>> =
        (0..study.count()).map(|i| Some(ishigami(&numbers(&study, i)))).collect();
    let whole = indices(&results[..5 * 63], 3).unwrap().0;
    results[5 * 63 + 2] = None;
    assert_eq!(indices(&results, 3).unwrap(), (whole, 1));
    assert!(indices(&[Some(1.0); 15], 3).is_none());
    assert!(indices(&[None; 15], 3).is_none());
}

/// Estimators and point order of a Saltelli design match SALib (PyPI), which can analyse our points.
#[test]
fn salib_finds_the_same_indices_in_our_points() {
    let study = of_ranges("saltelli", 256, 7, 3);
    let results: Vec<f64> = (0..study.count()).map(|i| ishigami(&numbers(&study, i))).collect();
    let packages = ["SALib==1.5.2", "numpy==2.4.6", "scipy==1.17.1"];
    let Some(python) = test_support::python::or_skip("salib", &packages, "SALib") else { return };
    let script = format!(
        "import json, numpy as np\nfrom SALib.analyze import sobol\n\
         p = {{'num_vars': 3, 'names': ['a', 'b', 'c'], 'bounds': [[0, 1]] * 3}}\n\
         s = sobol.analyze(p, np.array({results:?}), calc_second_order=False, seed=1)\n\
         print(*s['S1'], *s['ST'])"
    );
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("salib.py"), script).unwrap();
    let output = Command::new(python).arg(folder.path().join("salib.py")).limited_output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    let theirs: Vec<f64> = text.split_whitespace().map(|x| x.parse().unwrap()).collect();
    let ours = indices(&results.iter().copied().map(Some).collect::<Vec<_>>(), 3).unwrap().0;
    for (index, ours) in ours.iter().enumerate() {
        assert!((ours.first_order - theirs[index]).abs() < 1e-9, "{ours:?} {theirs:?}");
        assert!((ours.total - theirs[3 + index]).abs() < 1e-9, "{ours:?} {theirs:?}");
    }
}
