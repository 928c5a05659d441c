//! Locates TOML errors: the key at a position, and types in plain words.

use core::ops::Range;

use foreign_text::nearest_name;
use toml::de::{DeTable, DeValue};

/// The key whose name or value spans a byte of the text, with its path: `run.duration_s`,
/// `tool.direction[1]`. `None` outside all keys, or if the text is not TOML.
pub(crate) fn key_at(text: &str, byte: usize) -> Option<String> {
    let document = DeTable::parse(text).ok()?;
    let here = |path: &str, spans: [Range<usize>; 2]| {
        spans.iter().any(|span| span.contains(&byte)).then(|| path.to_owned())
    };
    search_table(document.get_ref(), "", &here)
}

/// The line, from 1, of a key by its path; `None` if the text lacks the key.
pub(crate) fn line_of(text: &str, wanted: &str) -> Option<usize> {
    let document = DeTable::parse(text).ok()?;
    let here = |path: &str, [key, _]: [Range<usize>; 2]| (path == wanted).then_some(key.start);
    let byte = search_table(document.get_ref(), "", &here)?;
    Some(foreign_text::line_at(text, byte))
}

/// Called with a key's path and the spans of its name and value; the first result ends the search. Nested
/// keys come before the key that contains them.
type Found<'f, T> = &'f dyn Fn(&str, [Range<usize>; 2]) -> Option<T>;

fn search_table<T>(table: &DeTable<'_>, path: &str, found: Found<'_, T>) -> Option<T> {
    table.iter().find_map(|(key, value)| {
        let name = key.get_ref();
        let path = if path.is_empty() { name.to_string() } else { format!("{path}.{name}") };
        search_value(value.get_ref(), &path, found).or_else(|| found(&path, [key.span(), value.span()]))
    })
}

fn search_value<T>(value: &DeValue<'_>, path: &str, found: Found<'_, T>) -> Option<T> {
    match value {
        DeValue::Table(table) => search_table(table, path, found),
        DeValue::Array(values) => values.iter().enumerate().find_map(|(index, value)| {
            let path = format!("{path}[{index}]");
            let below = search_value(value.get_ref(), &path, found);
            below.or_else(|| found(&path, [value.span(), value.span()]))
        }),
        _ => None,
    }
}

/// Start of the parser's message for a backslash that begins no escape, as in the path `"C:\data"`, and for a
/// `\U` without its digits, as in `"C:\Users"`.
const BAD_ESCAPES: [&str; 2] = ["missing escaped value", "too few unicode value digits"];

/// The parser's message with types in plain words: `expected f64` becomes `expected a number`.
pub(crate) fn in_words(message: &str) -> String {
    const WORDS: [(&str, &str); 10] = [
        ("expected f64", "expected a number"),
        ("expected f32", "expected a number"),
        ("expected u64", "expected a whole number, 0 or more"),
        ("expected u32", "expected a whole number, 0 or more"),
        ("expected i64", "expected a whole number"),
        ("expected i16", "expected a whole number, -32768 to 32767"),
        ("expected any valid TOML value", "expected a 64-bit number"),
        ("expected a boolean", "expected true or false"),
        ("expected a sequence", "expected a list"),
        ("expected a map", "expected a table"),
    ];
    if BAD_ESCAPES.iter().any(|start| message.starts_with(start)) {
        return format!("{message}; {}", crate::BACKSLASH);
    }
    let message = WORDS.iter().fold(message.to_owned(), |text, (typed, word)| text.replace(typed, word));
    with_nearest_name(&message).unwrap_or(message)
}

/// Adds the nearest valid name to the parser's message about an unknown key or value, which quotes all names;
/// `None` for any other message, and if none is near.
fn with_nearest_name(message: &str) -> Option<String> {
    let (unknown, expected) = message.split_once(", expected ")?;
    let given = unknown.strip_prefix("unknown ")?.split('`').nth(1)?;
    let nearest = nearest_name(given, expected.split('`').skip(1).step_by(2))?;
    Some(format!("{unknown} (did you mean `{nearest}`?), expected {expected}"))
}

/// Whether the text has a comma between two digits at or just before a byte, where the parser gave up.
pub(crate) fn is_decimal_comma(text: &str, byte: usize) -> bool {
    let line_start = text[..byte.min(text.len())].rfind('\n').map_or(0, |at| at + 1);
    let line = text[line_start..].lines().next().unwrap_or_default();
    let value = line.split_once('=').map_or("", |(_, value)| value.trim());
    is_number_with_comma(value.split('#').next().unwrap_or_default().trim())
}

/// Whether a text is a number with a comma in place of its point.
pub fn is_number_with_comma(text: &str) -> bool {
    text.matches(',').count() == 1 && text.replace(',', ".").parse::<f64>().is_ok_and(|x| x.is_finite())
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by it")]
mod tests {
    use std::path::Path;

    use crate::Scene;

    const TEXT: &str = "name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[tool]\n\
                        burr_start_mm = [0.0, 0.0, 0.0]\ndirection = [1.0, 0.0, 0.0]\nbend_toward = [0.0, \
                        0.0, 1.0]\n\
                        [[controller]]\nname = \"c\"\ndrives = []\nexternal = true\n";

    /// Regression: the parser's message speaks of Unicode digits, and the user has written a path.
    #[test]
    fn a_path_with_backslashes_gets_a_hint() {
        for path in ["C:\\Users\\me\\ct.nrrd", "D:\\ct.nrrd"] {
            let text = TEXT.replace("[run]", &format!("[volume]\nfile = \"{path}\"\n[run]"));
            let error = Scene::parse(&text, Path::new("x.toml")).unwrap_err().to_string();
            assert!(error.starts_with("x.toml, line 3: ") && error.contains("single quotes"), "{error}");
        }
    }

    /// Regression: only the list of all names followed, of which the meant one is hard to find.
    #[test]
    fn an_unknown_key_gets_the_nearest_name_and_a_decimal_comma_a_hint() {
        let refused = |from: &str, to: &str| {
            Scene::parse(&TEXT.replacen(from, to, 1), Path::new("a.toml")).unwrap_err().to_string()
        };
        for (from, to, hint) in [
            (
                "[[controller]]",
                "[[controler]]",
                "`controler` (did you mean `controller`?), expected one of `",
            ),
            ("duration_s", "duration", "`duration` (did you mean `duration_s`?), expected one of `"),
            (
                "drives = []",
                "drives = [\"tendons\"]",
                "`tendons` (did you mean `tendon`?), expected one of `",
            ),
            ("duration_s = 1.0", "duration_s = 1,5", "write a decimal point, not a comma"),
        ] {
            let error = refused(from, to);
            assert!(error.contains(hint), "{error}");
        }
        let far = refused("duration_s", "zzz");
        assert!(far.contains("unknown field `zzz`, expected") && !far.contains("did you mean"), "{far}");
    }

    /// The bare parser message, `invalid type: string "long", expected f64`, names neither the key nor a TOML
    /// type.
    #[test]
    fn a_value_of_a_wrong_type_is_refused_with_its_key_and_the_type_in_words() {
        let refused = |from: &str, to: &str| {
            let error = Scene::parse(&TEXT.replacen(from, to, 1), Path::new("a.toml")).unwrap_err();
            error.to_string()
        };
        for (from, to, said) in [
            (
                "duration_s = 1.0",
                "duration_s = \"long\"",
                "line 4: `run.duration_s`: invalid type: string \"long\", expected a number",
            ),
            (
                "[1.0, 0.0, 0.0]",
                "[1.0, \"x\", 0.0]",
                "line 7: `tool.direction[1]`: invalid type: string \"x\", expected a number",
            ),
            (
                "[tool]",
                "[volume]\nbone_threshold_hu = 40000\n[tool]",
                "line 6: `volume.bone_threshold_hu`: invalid value: integer `40000`, expected a whole \
                 number, -32768 to 32767",
            ),
            (
                "external = true",
                "external = 1",
                "line 12: `controller[0].external`: invalid type: integer `1`, expected true or false",
            ),
            (
                "duration_s = 1.0",
                "duration = 1.0",
                "line 4: `run.duration`: unknown field `duration` (did you mean `duration_s`?), expected one of ",
            ),
            (
                "burr_start_mm = [0.0, 0.0, 0.0]",
                "burr_start_mm = [0.0]",
                "line 6: `tool.burr_start_mm`: invalid length 1, expected ",
            ),
        ] {
            let error = refused(from, to);
            assert!(error.contains(said), "{error}\nis not\n{said}");
        }
        let syntax = refused("[run]", "[run");
        assert!(syntax.starts_with("a.toml, line 2: ") && !syntax.contains("`run"), "{syntax}");
    }
}
