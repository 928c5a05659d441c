//! The JSON schema of scene files, derived by `schemars` from the declarations in [`model`](crate::model).

use schemars::generate::SchemaSettings;
use schemars::transform::RecursiveTransform;
use schemars::{JsonSchema, Schema};
use serde_json::{Map, Value, json};

use crate::Scene;

/// Returns the JSON schema of scene files for editors: draft 7, which TOML editors support.
///
/// It holds each key's type, range, default and text, and refuses unknown keys. Relations between keys, such
/// as "either `phantom` or `path`", are checked only by [`Scene::parse`].
pub fn json_schema() -> Value {
    let mut schema = generate::<Scene>(SchemaSettings::draft07());
    allow_plan(&mut schema);
    schema
}

/// Keys that are required unless `tool.plan` gives them: table and key.
const OF_A_PLAN: [(&str, &str); 7] = [
    ("Tool", "burr_start_mm"),
    ("Tool", "direction"),
    ("Tool", "bend_toward"),
    ("Drr", "isocentre_mm"),
    ("CurvedDrilling", "insertion_mm"),
    ("CurvedDrilling", "ramp_end_mm"),
    ("Skiving", "depth_mm"),
];

/// Makes keys optional that a plan gives. An editor validates one table at a time: in `[tool]` it sees
/// whether there is a plan, elsewhere it does not.
fn allow_plan(schema: &mut Value) {
    for (table, key) in OF_A_PLAN {
        if let Some(required) = schema["definitions"][table]["required"].as_array_mut() {
            required.retain(|name| name != key);
        }
    }
    let without: Vec<&str> =
        OF_A_PLAN.iter().filter(|(table, _)| *table == "Tool").map(|(_, key)| *key).collect();
    schema["definitions"]["Tool"]["anyOf"] = json!([{"required": ["plan"]}, {"required": without}]);
}

/// A type's schema for reading, with `$defs`; texts and defaults can accompany a `$ref`.
pub(crate) fn as_read<T: JsonSchema>() -> Value {
    generate::<T>(SchemaSettings::draft2020_12())
}

/// A type's schema for writing: `required` lists every key of a table, in declaration order.
pub(crate) fn as_written<T: JsonSchema>() -> Value {
    generate::<T>(SchemaSettings::draft2020_12().for_serialize())
}

fn generate<T: JsonSchema>(mut settings: SchemaSettings) -> Value {
    // Before the draft's own transforms, which would wrap the alternatives of an optional table.
    settings.transforms.insert(0, Box::new(RecursiveTransform(remove_null)));
    settings.into_generator().into_root_schema_for::<T>().into()
}

/// TOML has no null: an optional key is present or absent.
fn remove_null(schema: &mut Schema) {
    let Some(object) = schema.as_object_mut() else { return };
    if let Some(Value::Array(types)) = object.get_mut("type") {
        types.retain(|kind| kind != "null");
        if let [only] = &types[..] {
            let only = only.clone();
            object.insert("type".to_owned(), only);
        }
    }
    if let Some(alternatives) = object.get("anyOf").and_then(Value::as_array)
        && let [Value::Object(table), null] | [null, Value::Object(table)] = &alternatives[..]
        && null["type"] == "null"
    {
        let table = table.clone();
        object.remove("anyOf");
        table.into_iter().for_each(|(key, value)| _ = object.entry(key).or_insert(value));
    }
    match object.get_mut("default") {
        Some(Value::Null) => _ = object.remove("default"),
        Some(Value::Object(default)) => remove_null_members(default),
        _ => {}
    }
}

fn remove_null_members(object: &mut Map<String, Value>) {
    object.retain(|_, value| !value.is_null());
    object.values_mut().filter_map(Value::as_object_mut).for_each(remove_null_members);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn each_value(value: &Value, look: &mut dyn FnMut(&Value)) {
        look(value);
        match value {
            Value::Array(values) => values.iter().for_each(|value| each_value(value, look)),
            Value::Object(object) => object.values().for_each(|value| each_value(value, look)),
            _ => {}
        }
    }

    /// An editor would offer `null`, which TOML cannot represent.
    #[test]
    fn the_schema_knows_no_null() {
        let schema = json_schema();
        each_value(&schema, &mut |value| assert!(!value.is_null() && *value != "null", "{value}"));
        let phantom = &schema["definitions"]["Volume"]["properties"]["phantom"];
        assert_eq!(phantom["allOf"][0]["$ref"], "#/definitions/Phantom");
        assert_eq!(schema["definitions"]["Contact"]["properties"]["friction"]["type"], "number");
    }

    #[test]
    fn the_schema_refuses_unknown_keys_in_every_table() {
        let schema = json_schema();
        let mut count = 0;
        each_value(&schema, &mut |value| {
            if value["properties"].is_object() {
                count += 1;
                assert_eq!(value["additionalProperties"], false, "{value}");
            }
        });
        assert_eq!(count, 63, "tables, the top level among them");
    }

    /// One declaration: schema, check and reference agree.
    #[test]
    fn the_schema_holds_type_range_default_and_text_of_a_key() {
        let schema = json_schema();
        let key = &schema["definitions"]["Run"]["properties"]["dt_ms"];
        let expected = serde_json::json!({
            "type": "number", "format": "double", "minimum": 0.1, "maximum": 10.0, "default": 1.0,
            "description": "Time step.",
        });
        assert_eq!(*key, expected);
        assert_eq!(schema["definitions"]["Run"]["required"], serde_json::json!(["mode", "duration_s"]));
    }
}
