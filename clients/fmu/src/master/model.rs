//! The model description of somebody else's FMU.

use roxmltree::{Document, Node, ParsingOptions};

use super::{folder_of, malformed};
use crate::error::FmuError;

/// Longest model description.
pub(super) const MOST_TEXT_BYTES: u64 = 64 << 20;
/// Most elements and attributes of a model description.
const MOST_NODES: u32 = 4_000_000;

/// Type of a variable that a controller can be connected to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VariableType {
    /// `Float64`, or `Real` of FMI 2.0.
    Float,
    /// `Int32`, or `Integer` of FMI 2.0.
    Int,
    /// `UInt32`.
    UInt,
    /// `Boolean`.
    Boolean,
}

/// A variable of one element.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ForeignVariable {
    /// Name.
    pub name: String,
    /// Value reference.
    pub reference: u32,
    /// Type.
    pub kind: VariableType,
    /// `input`, `output`, `parameter` or another causality.
    pub causality: String,
}

/// What a model description says of an FMU for co-simulation.
#[derive(Debug, Clone, PartialEq)]
pub struct ForeignModel {
    /// Name of the model.
    pub name: String,
    /// True for FMI 3.0, false for FMI 2.0.
    pub three: bool,
    /// Token or GUID.
    pub token: String,
    /// Name of its library without suffix.
    pub identifier: String,
    /// Step of its default experiment, s.
    pub step_s: Option<f64>,
    /// Step of its own solver, s, of which every step must be a multiple.
    pub fixed_step_s: Option<f64>,
    /// Variables of one element and a known type.
    pub variables: Vec<ForeignVariable>,
    /// Names of the other variables, and what they are.
    pub unsupported: Vec<(String, &'static str)>,
}

fn attribute(node: &Node, name: &str) -> Result<String, FmuError> {
    let element = node.tag_name().name();
    let found = node.attribute(name).ok_or_else(|| malformed(format!("`{element}` has no `{name}`")))?;
    Ok(found.to_owned())
}

fn child<'a, 'i>(node: &Node<'a, 'i>, name: &str) -> Option<Node<'a, 'i>> {
    node.children().find(|child| child.has_tag_name(name))
}

impl ForeignModel {
    /// Parses a model description.
    ///
    /// # Errors
    /// If it is not one of FMI 2.0 or 3.0 for co-simulation.
    pub fn parse(text: &str) -> Result<ForeignModel, FmuError> {
        // A document type could define entities that grow without bound; no model description has one.
        let options =
            ParsingOptions { allow_dtd: false, nodes_limit: MOST_NODES, ..ParsingOptions::default() };
        let document = Document::parse_with_options(text, options)
            .map_err(|cause| malformed(format!("modelDescription.xml: {cause}")))?;
        let root = document.root_element();
        if !root.has_tag_name("fmiModelDescription") {
            return Err(malformed("modelDescription.xml: no `fmiModelDescription`"));
        }
        let version = attribute(&root, "fmiVersion")?;
        let three = match version.as_str() {
            "2.0" => false,
            version if version.starts_with("3.") => true,
            other => return Err(malformed(format!("FMI {other}, expected 2.0 or 3.0"))),
        };
        let simulation = child(&root, "CoSimulation").ok_or_else(|| malformed("not for co-simulation"))?;
        let identifier = attribute(&simulation, "modelIdentifier")?;
        let is_identifier = identifier.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
        if !is_identifier || identifier.is_empty() {
            return Err(malformed("`modelIdentifier` is not the name of a C function"));
        }
        let experiment = child(&root, "DefaultExperiment");
        let step_s = experiment.and_then(|node| node.attribute("stepSize")?.parse().ok());
        let fixed_step_s = simulation.attribute("fixedInternalStepSize").and_then(|text| text.parse().ok());
        let list = child(&root, "ModelVariables").ok_or_else(|| malformed("no `ModelVariables`"))?;
        let type_of = if three { type_of_three } else { type_of_two };
        let (mut variables, mut unsupported) = (Vec::new(), Vec::new());
        for node in list.children().filter(Node::is_element) {
            match type_of(&node) {
                Ok(kind) => variables.push(variable(&node, kind)?),
                Err(what) => unsupported.push((attribute(&node, "name")?, what)),
            }
        }
        Ok(ForeignModel {
            name: attribute(&root, "modelName")?,
            three,
            token: attribute(&root, if three { "instantiationToken" } else { "guid" })?,
            identifier,
            step_s,
            fixed_step_s: fixed_step_s.filter(|step_s: &f64| step_s.is_finite() && *step_s > 0.0),
            variables,
            unsupported,
        })
    }

    /// Path of the library for this machine in the archive.
    pub(super) fn library(&self) -> String {
        format!("binaries/{}/{}.so", folder_of(self.three), self.identifier)
    }

    /// Finds a variable by its name.
    pub fn variable(&self, name: &str) -> Option<&ForeignVariable> {
        self.variables.iter().find(|variable| variable.name == name)
    }
}

fn variable(node: &Node, kind: VariableType) -> Result<ForeignVariable, FmuError> {
    let reference = attribute(node, "valueReference")?;
    Ok(ForeignVariable {
        name: attribute(node, "name")?,
        reference: reference.parse().map_err(|_| malformed("a `valueReference` is no number"))?,
        kind,
        causality: node.attribute("causality").unwrap_or("local").to_owned(),
    })
}

/// Description of a variable whose type no controller can be connected to.
const OTHER_TYPE: &str = "of another type";

fn type_of_three(node: &Node) -> Result<VariableType, &'static str> {
    if child(node, "Dimension").is_some() {
        return Err("an array");
    }
    match node.tag_name().name() {
        "Float64" => Ok(VariableType::Float),
        "Int32" => Ok(VariableType::Int),
        "UInt32" => Ok(VariableType::UInt),
        "Boolean" => Ok(VariableType::Boolean),
        _ => Err(OTHER_TYPE),
    }
}

fn type_of_two(node: &Node) -> Result<VariableType, &'static str> {
    let is = |name| child(node, name).is_some();
    match () {
        () if is("Real") => Ok(VariableType::Float),
        () if is("Integer") => Ok(VariableType::Int),
        () if is("Boolean") => Ok(VariableType::Boolean),
        () => Err(OTHER_TYPE),
    }
}
