//! The declarations of a scene's keys as values, read from the JSON schema, for the range checks and the
//! reference page.

use std::sync::LazyLock;

use schemars::JsonSchema;
use serde_json::Value;

use crate::schema::{as_read, as_written};
use crate::{Scene, ToolDescription};

/// A table of a scene file.
#[derive(Debug)]
pub(crate) struct Table {
    pub(crate) doc: String,
    /// In declaration order.
    pub(crate) keys: Vec<Key>,
}

/// A key of a table.
#[derive(Debug)]
pub(crate) struct Key {
    pub(crate) name: String,
    pub(crate) doc: String,
    pub(crate) kind: Kind,
    pub(crate) absent: AbsentValue,
}

/// Type of a key's value.
#[derive(Debug)]
pub(crate) enum Kind {
    Number(Option<Range>),
    Integer(Option<Range>),
    Boolean,
    /// With a pattern, if not every text is allowed.
    Text(Option<Pattern>),
    /// An integer or a text.
    IntegerOrText,
    Path,
    OneOf(Vec<String>),
    /// Element kind, smallest and largest number of elements.
    List(Box<Kind>, Option<u64>, Option<u64>),
    Table(Table),
    /// A table with keys of the user's choice, all with values of this kind.
    Map(Box<Kind>),
    /// A schema form that this module does not know. A test checks that no key has it.
    Unknown,
}

/// Allowed values of a number, both ends included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Range {
    pub(crate) lowest: f64,
    pub(crate) highest: f64,
    /// Zero is also allowed, and switches something off.
    pub(crate) or_zero: bool,
}

/// A regular expression, and its description.
#[derive(Debug)]
pub(crate) struct Pattern {
    pub(crate) expression: String,
    pub(crate) expected: String,
}

/// What applies if a key is absent.
#[derive(Debug, PartialEq)]
pub(crate) enum AbsentValue {
    /// The scene is refused.
    Refused,
    Default(Value),
    /// Text of the reference: `standard` or `none`.
    Word(String),
}

/// The top level of a scene file.
pub(crate) static SCENE: LazyLock<Table> = LazyLock::new(table_of::<Scene>);

/// The top level of a tool file.
pub(crate) static TOOL: LazyLock<Table> = LazyLock::new(table_of::<ToolDescription>);

fn table_of<T: JsonSchema>() -> Table {
    let (read, written) = (as_read::<T>(), as_written::<T>());
    Reader { read: &read, written: &written }.table(&read, &written)
}

/// Returns the default of a scene's key if it is a list; array indices are omitted from its path.
pub fn list_default(path: &str) -> Option<toml::Value> {
    let (above, name) = path.rsplit_once('.').map_or((None, path), |(above, name)| (Some(above), name));
    let table = above.map_or(Some(&*SCENE), |above| SCENE.kind(above)?.table())?;
    match &table.keys.iter().find(|key| key.name == name)?.absent {
        AbsentValue::Default(default @ Value::Array(_)) => toml::Value::try_from(default).ok(),
        _ => None,
    }
}

impl Table {
    /// The kind of a key by its path, such as `run.dt_ms`; array indices are omitted.
    pub(crate) fn kind(&self, path: &str) -> Option<&Kind> {
        let (first, rest) = path.split_once('.').map_or((path, None), |(first, rest)| (first, Some(rest)));
        let kind = &self.keys.iter().find(|key| key.name == first)?.kind;
        match (rest, kind) {
            (None, kind) => Some(kind),
            (Some(rest), kind) => kind.table()?.kind(rest),
        }
    }
}

impl Kind {
    /// The table that a key opens, directly or as an array.
    pub(crate) fn table(&self) -> Option<&Table> {
        match self {
            Kind::Table(table) => Some(table),
            Kind::List(of, ..) => match &**of {
                Kind::Table(table) => Some(table),
                _ => None,
            },
            _ => None,
        }
    }

    /// The range of a number, or of each number of a list.
    pub(crate) fn range(&self) -> Option<Range> {
        match self {
            Kind::Number(range) | Kind::Integer(range) => *range,
            Kind::List(of, ..) => of.range(),
            _ => None,
        }
    }
}

/// Two schemas of one type, with the definitions they refer to.
struct Reader<'a> {
    read: &'a Value,
    written: &'a Value,
}

impl Reader<'_> {
    fn table(&self, read: &Value, written: &Value) -> Table {
        let none = serde_json::Map::new();
        let properties = read["properties"].as_object().unwrap_or(&none);
        let required: Vec<&str> = texts(&read["required"]).collect();
        let word = read["x-absent"].as_str().unwrap_or("none");
        let key = |(name, schema): (&str, &Value)| Key {
            name: name.to_owned(),
            doc: doc(schema),
            kind: self.kind(schema),
            absent: match &schema["default"] {
                _ if required.contains(&name) => AbsentValue::Refused,
                Value::Null => AbsentValue::Word(schema["x-absent"].as_str().unwrap_or(word).to_owned()),
                default => AbsentValue::Default(default.clone()),
            },
        };
        let in_order = texts(&written["required"]);
        let keys = in_order.filter_map(|name| properties.get_key_value(name));
        Table { doc: doc(read), keys: keys.map(|(name, schema)| key((name, schema))).collect() }
    }

    fn kind(&self, schema: &Value) -> Kind {
        if let Some(name) = schema["$ref"].as_str().and_then(|target| target.strip_prefix("#/$defs/")) {
            let (read, written) = (&self.read["$defs"][name], &self.written["$defs"][name]);
            return match (&read["oneOf"], &read["anyOf"]) {
                (Value::Array(values), _) => Kind::OneOf(
                    values.iter().filter_map(|one| one["const"].as_str()).map(str::to_owned).collect(),
                ),
                (_, Value::Array(forms)) => either(forms),
                _ => Kind::Table(self.table(read, written)),
            };
        }
        match schema["type"].as_str() {
            Some("number") => Kind::Number(range(schema)),
            Some("integer") => Kind::Integer(range(schema)),
            Some("boolean") => Kind::Boolean,
            Some("string") if schema["x-kind"] == "path" => Kind::Path,
            Some("string") => Kind::Text(pattern(schema)),
            Some("array") => {
                let of = self.kind(&schema["items"]);
                Kind::List(Box::new(of), schema["minItems"].as_u64(), schema["maxItems"].as_u64())
            }
            Some("object") if schema["additionalProperties"].is_object() => {
                Kind::Map(Box::new(self.kind(&schema["additionalProperties"])))
            }
            _ => Kind::Unknown,
        }
    }
}

/// The kind of a value with alternative forms.
fn either(forms: &[Value]) -> Kind {
    let types: Vec<&str> = forms.iter().filter_map(|form| form["type"].as_str()).collect();
    match types.as_slice() {
        ["integer", "string"] => Kind::IntegerOrText,
        _ => Kind::Unknown,
    }
}

fn range(schema: &Value) -> Option<Range> {
    let ends = |schema: &Value| schema["minimum"].as_f64().zip(schema["maximum"].as_f64());
    let of = |or_zero| move |(lowest, highest)| Range { lowest, highest, or_zero };
    let alternatives = schema["anyOf"].as_array();
    ends(schema).map(of(false)).or_else(|| alternatives?.iter().find_map(ends).map(of(true)))
}

fn pattern(schema: &Value) -> Option<Pattern> {
    let text = |key: &str| schema[key].as_str().map(str::to_owned);
    Some(Pattern { expression: text("pattern")?, expected: text("patternErrorMessage")? })
}

fn texts(list: &Value) -> impl Iterator<Item = &str> {
    list.as_array().into_iter().flatten().filter_map(Value::as_str)
}

/// Returns a doc comment as a single line.
fn doc(schema: &Value) -> String {
    schema["description"].as_str().unwrap_or_default().replace('\n', " ")
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by it")]
mod tests {
    use super::*;

    fn each_key<'t>(table: &'t Table, path: &str, look: &mut dyn FnMut(&str, &'t Key)) {
        for key in &table.keys {
            let path = format!("{path}{}", key.name);
            look(&path, key);
            if let Some(table) = key.kind.table() {
                each_key(table, &format!("{path}."), look);
            }
        }
    }

    fn is_known(kind: &Kind) -> bool {
        match kind {
            Kind::List(of, ..) | Kind::Map(of) => is_known(of),
            Kind::OneOf(values) => !values.is_empty(),
            Kind::Table(table) => !table.keys.is_empty(),
            kind => !matches!(kind, Kind::Unknown),
        }
    }

    /// Number of keys of a table and of the tables below it. A table used in two places, as `[contact]` and
    /// `[truth.contact]`, is defined once and referred to twice.
    fn declared(schema: &Value, definitions: &Value) -> usize {
        let keys = schema["properties"].as_object().map_or(0, serde_json::Map::len);
        let text = schema["properties"].to_string();
        let below = text.split("\"#/$defs/").skip(1).filter_map(|rest| rest.split('"').next());
        keys + below.map(|name| declared(&definitions[name], definitions)).sum::<usize>()
    }

    /// A key lost here would have neither a range check nor a line in the reference.
    #[test]
    fn every_declared_key_is_read_with_its_kind_and_text() {
        let mut paths = Vec::new();
        each_key(&SCENE, "", &mut |path, key| {
            assert!(is_known(&key.kind), "{path}: {:?}", key.kind);
            assert!(!key.doc.is_empty(), "{path} has no text");
            paths.push(path.to_owned());
        });
        let read = as_read::<Scene>();
        assert_eq!(paths.len(), declared(&read, &read["$defs"]), "{paths:?}");
    }

    /// The unit ends a physical number's name; without a range any value would pass.
    #[test]
    fn every_physical_number_has_a_range_but_those_that_are_checked_elsewhere() {
        let mut without = Vec::new();
        each_key(&SCENE, "", &mut |path, key| {
            let is_number = |kind: &Kind| matches!(kind, Kind::Number(_) | Kind::Integer(_));
            let holds_numbers = match &key.kind {
                Kind::List(of, ..) => is_number(of) || matches!(&**of, Kind::List(..)),
                kind => is_number(kind),
            };
            if holds_numbers && key.kind.range().is_none() {
                without.push(path.to_owned());
            }
        });
        let elsewhere = [
            "run.seed",
            "tool.direction",
            "tool.bend_toward",
            "drr.carm.intrinsics",
            "drr.carm.rotation",
            "drr.carm.translation_mm",
            "drr.carm.source_mm",
            "drr.carm.detector_centre_mm",
            "drr.carm.row_axis",
            "drr.carm.column_axis",
            "drr.object.balls.centres_mm",
            "structure.tube.points_mm",
            "structure.label.voxels.axes",
        ];
        assert_eq!(without, elsewhere);
    }

    /// Only keys that are set are checked against their ranges.
    #[test]
    fn every_default_is_within_its_range() {
        let mut count = 0;
        each_key(&SCENE, "", &mut |path, key| {
            let (AbsentValue::Default(default), Some(range)) = (&key.absent, key.kind.range()) else {
                return;
            };
            count += 1;
            let values: Vec<f64> = match default {
                Value::Array(values) => values.iter().map(|value| value.as_f64().unwrap()).collect(),
                value => vec![value.as_f64().unwrap()],
            };
            assert!(values.iter().all(|value| range.allows(*value)), "{path}: {default} is not in {range:?}");
        });
        assert!(count > 50, "{count} keys");
    }
}
