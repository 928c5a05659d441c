//! `modelDescription.xml` of both versions.

use std::fmt::Write as _;

use crate::variables::{Causality, Kind, Place, Start, Variable, Variables};

/// A version of the standard.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Version {
    /// FMI 2.0: a variable for each element of an array, no X-ray frames.
    Two,
    /// FMI 3.0: arrays and binary variables.
    Three,
}

/// Name of the library in an FMU, without its suffix.
pub(crate) const MODEL: &str = "trabecula";

/// Base units of each unit that variables have: exponents of kg, m and s, and of rad.
const UNITS: [(&str, &str); 9] = [
    ("N", r#"kg="1" m="1" s="-2""#),
    ("N m", r#"kg="1" m="2" s="-2""#),
    ("J", r#"kg="1" m="2" s="-2""#),
    ("m", r#"m="1""#),
    ("m/s", r#"m="1" s="-1""#),
    ("rad", r#"rad="1""#),
    ("rad/s", r#"rad="1" s="-1""#),
    ("kg", r#"kg="1""#),
    ("s", r#"s="1""#),
];

/// What a model description says beside its variables.
#[derive(Debug, Clone)]
pub(crate) struct Model {
    pub name: String,
    pub description: String,
    pub token: String,
    pub tool: String,
    pub dt_s: f64,
    pub stop_s: f64,
}

/// Escapes a text for an attribute; characters that XML 1.0 forbids are left out.
fn escaped(text: &str) -> String {
    let mut out = String::new();
    for character in text.chars() {
        match character {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\n' | '\t' => out.push(' '),
            other if other.is_control() || matches!(other, '\u{fffe}' | '\u{ffff}') => {}
            other => out.push(other),
        }
    }
    out
}

fn units() -> String {
    let unit = |(name, base): &(&str, &str)| format!("    <Unit name=\"{name}\"><BaseUnit {base}/></Unit>\n");
    format!("  <UnitDefinitions>\n{}  </UnitDefinitions>\n", UNITS.iter().map(unit).collect::<String>())
}

fn start(variable: &Variable) -> String {
    match &variable.place {
        Place::Key(_, Start::Float(value)) => format!("{value:?}"),
        Place::Key(_, Start::Whole(value)) => value.to_string(),
        Place::Key(_, Start::Flag(value)) => value.to_string(),
        _ => vec!["0"; variable.elements()].join(" "),
    }
}

fn unit(variable: &Variable) -> String {
    let known = UNITS.iter().any(|(name, _)| *name == variable.unit);
    if known { format!(" unit=\"{}\"", variable.unit) } else { String::new() }
}

/// Writes the model description.
pub(crate) fn model_description(version: Version, model: &Model, variables: &Variables) -> String {
    match version {
        Version::Two => two(model, variables),
        Version::Three => three(model, variables),
    }
}

const HEAD: &str = "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n";
const LOGS: &str = "  <LogCategories>\n    <Category name=\"logStatusError\"/>\n  </LogCategories>\n";

fn three(model: &Model, variables: &Variables) -> String {
    let Model { name, description, token, tool, dt_s, stop_s } = model;
    let mut text = format!(
        "{HEAD}<fmiModelDescription fmiVersion=\"3.0\" modelName=\"{}\" instantiationToken=\"{token}\" \
         description=\"{}\" generationTool=\"{tool}\" variableNamingConvention=\"flat\">\n  <CoSimulation \
         modelIdentifier=\"{MODEL}\" canHandleVariableCommunicationStepSize=\"true\" \
         fixedInternalStepSize=\"{dt_s:?}\" canGetAndSetFMUState=\"true\" canSerializeFMUState=\"true\" \
         providesDirectionalDerivatives=\"true\"/>\n{}{LOGS}  <DefaultExperiment startTime=\"0\" \
         stopTime=\"{stop_s:?}\" stepSize=\"{dt_s:?}\"/>\n  <ModelVariables>\n",
        escaped(name),
        escaped(description),
        units(),
    );
    for variable in &variables.0 {
        let kind = variable.kind.name();
        let head = format!(
            "    <{kind} name=\"{}\" valueReference=\"{}\" description=\"{}\"",
            escaped(&variable.name),
            variable.reference,
            escaped(&variable.description)
        );
        let _ = match variable.causality {
            Causality::Independent => {
                write!(text, "{head} causality=\"independent\" variability=\"continuous\"{}", unit(variable))
            }
            Causality::Parameter => write!(
                text,
                "{head} causality=\"parameter\" variability=\"fixed\" start=\"{}\"{}",
                start(variable),
                unit(variable)
            ),
            Causality::Input => write!(
                text,
                "{head} causality=\"input\" variability=\"discrete\" start=\"{}\"{}",
                start(variable),
                unit(variable)
            ),
            Causality::Output => {
                let mime =
                    if variable.kind == Kind::Binary { " mimeType=\"application/octet-stream\"" } else { "" };
                write!(text, "{head} causality=\"output\" variability=\"discrete\"{mime}{}", unit(variable))
            }
        };
        let _ = match variable.length {
            None => writeln!(text, "/>"),
            Some(length) => writeln!(text, "><Dimension start=\"{length}\"/></{kind}>"),
        };
    }
    text.push_str("  </ModelVariables>\n  <ModelStructure>\n");
    for element in ["Output", "InitialUnknown"] {
        for variable in outputs(variables) {
            let _ = writeln!(text, "    <{element} valueReference=\"{}\"/>", variable.reference);
        }
    }
    text.push_str("  </ModelStructure>\n</fmiModelDescription>\n");
    text
}

fn outputs(variables: &Variables) -> impl Iterator<Item = &Variable> {
    variables.0.iter().filter(|variable| variable.causality == Causality::Output)
}

/// Type of a variable in FMI 2.0, whose integers have 32 bits: larger ones are reals. `None` for what it
/// cannot express.
pub(crate) fn kind_of_two(variable: &Variable) -> Option<&'static str> {
    match (&variable.kind, &variable.place) {
        (Kind::Int64, Place::Key(_, Start::Whole(value))) if i32::try_from(*value).is_err() => None,
        (Kind::Float64 | Kind::UInt64, _) => Some("Real"),
        (Kind::UInt32 | Kind::Int64, _) => Some("Integer"),
        (Kind::Boolean, _) => Some("Boolean"),
        (Kind::String, _) => Some("String"),
        (Kind::Binary, _) => None,
    }
}

fn two(model: &Model, variables: &Variables) -> String {
    let Model { name, description, token, tool, dt_s, stop_s } = model;
    let mut text = format!(
        "{HEAD}<fmiModelDescription fmiVersion=\"2.0\" modelName=\"{}\" guid=\"{token}\" description=\"{}\" \
         generationTool=\"{tool}\" variableNamingConvention=\"flat\">\n  <CoSimulation \
         modelIdentifier=\"{MODEL}\" canHandleVariableCommunicationStepSize=\"true\" \
         canGetAndSetFMUstate=\"true\" canSerializeFMUstate=\"true\" \
         providesDirectionalDerivative=\"true\"/>\n{}{LOGS}  <DefaultExperiment startTime=\"0\" \
         stopTime=\"{stop_s:?}\" stepSize=\"{dt_s:?}\"/>\n  <ModelVariables>\n",
        escaped(name),
        escaped(description),
        units(),
    );
    let (mut index, mut outputs) = (0, Vec::new());
    for variable in &variables.0 {
        let Some(kind) = kind_of_two(variable).filter(|_| variable.causality != Causality::Independent)
        else {
            continue;
        };
        for element in 0..variable.elements() {
            index += 1;
            let place = variable.length.map_or(String::new(), |_| format!("[{element}]"));
            let (causality, start) = match variable.causality {
                Causality::Input => ("causality=\"input\" variability=\"discrete\"", Some("0".to_owned())),
                Causality::Output => {
                    outputs.push(index);
                    ("causality=\"output\" variability=\"discrete\" initial=\"calculated\"", None)
                }
                Causality::Parameter | Causality::Independent => (
                    "causality=\"parameter\" variability=\"fixed\" initial=\"exact\"",
                    Some(self::start(variable)),
                ),
            };
            let start = start.map_or(String::new(), |start| format!(" start=\"{start}\""));
            let unit = if kind == "Real" { unit(variable) } else { String::new() };
            let _ = writeln!(
                text,
                "    <ScalarVariable name=\"{}{place}\" valueReference=\"{}\" description=\"{}\" \
                 {causality}><{kind}{unit}{start}/></ScalarVariable>",
                escaped(&variable.name),
                variable.reference + element as u32,
                escaped(&variable.description),
            );
        }
    }
    text.push_str("  </ModelVariables>\n  <ModelStructure>\n");
    for list in ["Outputs", "InitialUnknowns"] {
        let _ = writeln!(text, "    <{list}>");
        for index in &outputs {
            let _ = writeln!(text, "      <Unknown index=\"{index}\"/>");
        }
        let _ = writeln!(text, "    </{list}>");
    }
    text.push_str("  </ModelStructure>\n</fmiModelDescription>\n");
    text
}
