//! Checks every value of a scene file against its declared range.

use regex_lite::Regex;
use toml::Value;

use crate::check::Checker;
use crate::declaration::{Kind, Pattern, Range, Table};
use crate::error::SceneError;

impl Range {
    /// Whether a value is in the range; false for NaN.
    pub(crate) fn allows(&self, value: f64) -> bool {
        (self.or_zero && value == 0.0) || (value >= self.lowest && value <= self.highest)
    }
}

/// Checks the values of a table and of its nested tables, in declaration order; `path` is the table's own
/// key.
///
/// # Errors
/// [`SceneError::OutOfRange`], [`SceneError::Invalid`]: the first value that is not allowed.
pub(crate) fn check(
    declared: &Table,
    given: &toml::Table,
    path: &str,
    checker: &Checker,
) -> Result<(), SceneError> {
    for key in &declared.keys {
        let Some(value) = given.get(&key.name) else { continue };
        let path = if path.is_empty() { key.name.clone() } else { format!("{path}.{}", key.name) };
        check_value(&key.kind, value, &path, checker)?;
    }
    Ok(())
}

fn check_value(kind: &Kind, value: &Value, path: &str, checker: &Checker) -> Result<(), SceneError> {
    match (kind, value) {
        (Kind::Number(Some(range)) | Kind::Integer(Some(range)), Value::Float(value)) => {
            checker.range(path, *value, *range)
        }
        (Kind::Number(Some(range)) | Kind::Integer(Some(range)), Value::Integer(value)) => {
            checker.range(path, *value as f64, *range)
        }
        (Kind::Text(Some(pattern)), Value::String(text)) => check_text(pattern, text, path, checker),
        // Joined to the scene's folder, it would be that folder.
        (Kind::Path, Value::String(text)) if text.is_empty() => {
            Err(checker.invalid(path, "is \"\"; expected the path of a file"))
        }
        (Kind::List(of, least, most), Value::Array(values)) => {
            if least.is_some() || most.is_some() {
                let [lowest, highest] = [least.unwrap_or(0), most.unwrap_or(u64::MAX)].map(|end| end as f64);
                let count = Range { lowest, highest, or_zero: false };
                checker.range(&format!("{path} (count)"), values.len() as f64, count)?;
            }
            let is_vector = matches!(**of, Kind::Number(_) | Kind::Integer(_));
            values.iter().enumerate().try_for_each(|(index, value)| match is_vector {
                true => check_value(of, value, &format!("{path}[{index}]"), checker),
                false => check_value(of, value, path, checker),
            })
        }
        (Kind::Table(declared), Value::Table(given)) => check(declared, given, path, checker),
        // serde has already checked the types.
        _ => Ok(()),
    }
}

fn check_text(pattern: &Pattern, text: &str, path: &str, checker: &Checker) -> Result<(), SceneError> {
    let allowed = Regex::new(&pattern.expression).is_ok_and(|expression| expression.is_match(text));
    if allowed {
        return Ok(());
    }
    Err(checker.invalid(path, format!("is {text:?}; expected {}", pattern.expected)))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by it")]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::declaration::SCENE;

    /// Calls `look` with each key that has a range, its path, and its range.
    fn each_range(table: &Table, above: &[&str], look: &mut dyn FnMut(&[&str], &Kind, Range)) {
        for key in &table.keys {
            let path = [above, &[key.name.as_str()]].concat();
            if let Some(range) = key.kind.range() {
                look(&path, &key.kind, range);
            }
            if let Some(table) = key.kind.table() {
                each_range(table, &path, look);
            }
        }
    }

    /// A scene with this key alone.
    fn with_key(path: &[&str], kind: &Kind, value: f64) -> toml::Table {
        let mut value = match kind {
            Kind::List(_, Some(count), _) => Value::Array((0..*count).map(|_| Value::Float(value)).collect()),
            _ => Value::Float(value),
        };
        for depth in (1..path.len()).rev() {
            let table = Value::Table([(path[depth].to_owned(), value)].into_iter().collect());
            let is_array = matches!(SCENE.kind(&path[..depth].join(".")), Some(Kind::List(..)));
            value = if is_array { Value::Array(vec![table]) } else { table };
        }
        [(path[0].to_owned(), value)].into_iter().collect()
    }

    fn refused(scene: &toml::Table) -> Option<SceneError> {
        check(&SCENE, scene, "", &Checker { file: Path::new("a.toml") }).err()
    }

    #[test]
    fn every_range_holds_at_both_ends_and_refuses_what_is_beyond_and_nan() {
        let mut count = 0;
        each_range(&SCENE, &[], &mut |keys, kind, range| {
            count += 1;
            let component = if matches!(kind, Kind::List(..)) { "[0]" } else { "" };
            let path = keys.join(".") + component;
            let scene = |value| with_key(keys, kind, value);
            for allowed in [range.lowest, range.highest, 0.5 * (range.lowest + range.highest)] {
                assert_eq!(refused(&scene(allowed)), None, "{path}");
            }
            let beyond = 1e-6 * (range.highest - range.lowest);
            for value in
                [range.lowest - beyond, range.highest + beyond, f64::INFINITY, f64::NEG_INFINITY, f64::NAN]
            {
                let said = refused(&scene(value)).map(|error| error.to_string());
                let given = foreign_text::number(value);
                let expected =
                    format!("a.toml: `{path}` is {given}; allowed: {} to {}", range.lowest, range.highest);
                assert_eq!(said, Some(expected), "{path} = {value}");
            }
        });
        assert!(count > 90, "{count}");
    }

    #[test]
    fn zero_switches_keyframes_off_and_little_more_than_zero_is_refused() {
        let scene = |interval: &str| {
            toml::from_str(&format!("[recording]\nkeyframe_interval_s = {interval}")).unwrap()
        };
        assert_eq!(refused(&scene("0")), None);
        assert_eq!(refused(&scene("0.0")), None);
        let said = refused(&scene("0.001")).unwrap().to_string();
        assert_eq!(said, "a.toml: `recording.keyframe_interval_s` is 0.001; allowed: 0.01 to 3600");
    }

    #[test]
    fn too_many_tables_are_refused_with_their_number() {
        for (table, most) in [("body", 4), ("tendon", 4), ("sensor", 8), ("controller", 4)] {
            let scene = |count: usize| toml::from_str(&format!("[[{table}]]\n").repeat(count)).unwrap();
            assert_eq!(refused(&scene(most)), None);
            let said = refused(&scene(most + 1)).unwrap().to_string();
            assert_eq!(said, format!("a.toml: `{table} (count)` is {}; allowed: 0 to {most}", most + 1));
        }
    }

    #[test]
    fn a_name_that_is_no_name_is_refused_with_what_one_is() {
        let scene = |name: &str| [("name".to_owned(), Value::String(name.to_owned()))].into_iter().collect();
        let long = "a".repeat(64);
        for allowed in ["a-b_1", &long] {
            assert_eq!(refused(&scene(allowed)), None);
        }
        for name in ["", "a b", "../a", "ä", "a\n", &"a".repeat(65)] {
            let said = refused(&scene(name)).unwrap().to_string();
            assert!(said.ends_with("; expected 1 to 64 letters, digits, `_`, `-`"), "{said}");
        }
        let body = |name: &str| toml::from_str(&format!("[[body]]\nname = \"{name}\"")).unwrap();
        assert_eq!(refused(&body("a_b")), None);
        let said = refused(&body("a-b")).unwrap().to_string();
        assert_eq!(said, "a.toml: `body.name` is \"a-b\"; expected 1 to 64 letters, digits, `_`");
    }

    /// Regression: `volume.path = ""` was refused as the scene's folder, without the scene's name.
    #[test]
    fn an_empty_path_is_refused_with_its_key() {
        for (table, key) in [("[volume]", "volume.path"), ("[[arm.mesh]]", "arm.mesh.file")] {
            let name = key.rsplit('.').next().unwrap();
            let scene = |path: &str| toml::from_str(&format!("{table}\n{name} = \"{path}\"")).unwrap();
            assert_eq!(refused(&scene("a.nrrd")), None);
            let said = refused(&scene("")).unwrap().to_string();
            assert_eq!(said, format!("a.toml: `{key}` is \"\"; expected the path of a file"));
        }
    }

    #[test]
    fn of_a_vector_the_component_that_is_out_of_range_is_named() {
        let scene = toml::from_str("[tool]\nburr_start_mm = [0.0, 1e9, 0.0]").unwrap();
        let said = refused(&scene).unwrap().to_string();
        assert_eq!(said, "a.toml: `tool.burr_start_mm[1]` is 1e9; allowed: -100000 to 100000");
    }

    /// The reported error is always that of the key declared first, whatever the order in the file.
    #[test]
    fn the_first_error_is_that_of_the_key_declared_first() {
        let scene =
            toml::from_str("[arm]\nmax_speed_mm_per_s = -1\n[run]\nduration_s = 1e9\ndt_ms = 99\n").unwrap();
        let said = refused(&scene).unwrap().to_string();
        assert!(said.contains("`run.duration_s`"), "{said}");
    }
}
