//! `arm.urdf`: a serial arm from a URDF file (<https://wiki.ros.org/urdf/XML>, `joint` and `link`).
//!
//! The joints between base and tip go into the scene's table as `arm.joint` before parsing, and the meshes of
//! the links between them as `arm.mesh`. A [`Scene`](crate::Scene) therefore holds the arm's kinematics as
//! numbers, and so do its copies in the session and in the log; of the meshes, which only affect its
//! appearance, it holds the files' paths.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use foreign_text::{foreign, foreign_path};
use roxmltree::{Document, Error, Node, ParsingOptions};
use toml::{Table, Value};

use crate::check::Checker;
use crate::error::SceneError;
use crate::named_file::{ReadText, numbers, take_flag, take_text};
use crate::urdf_meshes::{self, MeshPlaces};

/// Largest number of XML nodes of a file: files of whole robots have some thousands.
const MOST_NODES: u32 = 200_000;
/// Largest number of joints between base and tip: as many as `arm.joint` takes.
const MOST_JOINTS: usize = 64;
/// Largest distance between consecutive joints.
pub(crate) const FARTHEST_M: f64 = 10.0;
/// Smallest range of a revolute joint, rad.
const LEAST_TURN_RAD: f64 = 2e-5;
/// Largest angle of a limit or an orientation: two turns.
pub(crate) const GREATEST_RAD: f64 = 4.0 * core::f64::consts::PI;
/// Range of a continuous joint, as for a wrist of Universal Robots.
const CONTINUOUS_RAD: f64 = 2.0 * core::f64::consts::PI;
/// Largest joint speed that counts as stated: 10 turns per second. Exporters write 0 or a huge number for an
/// unknown one.
const FASTEST_RAD_PER_S: f64 = 20.0 * core::f64::consts::PI;
/// Speed of a joint without a stated one, as for Universal Robots' arms; `arm.max_joint_speed_deg_per_s`
/// lowers it.
const USUAL_RAD_PER_S: f64 = core::f64::consts::PI;

/// Replaces `arm.urdf` and its keys in a scene's table by the joints and meshes of that file. Returns false
/// if the scene names no URDF file.
///
/// # Errors
/// The file cannot be read, or holds no serial arm that a scene supports.
pub(crate) fn put_in(
    scene: &mut Table,
    folder: &Path,
    read: &ReadText,
    checker: &Checker,
) -> Result<bool, SceneError> {
    let Some(Value::Table(arm)) = scene.get_mut("arm") else { return Ok(false) };
    let Some(file) = take_text(arm, ["arm", "urdf"], "a path", checker)? else { return Ok(false) };
    if arm.contains_key("joint") {
        return Err(checker.invalid("arm.joint", "and `arm.urdf` are mutually exclusive; set only one"));
    }
    if arm.contains_key("mesh") {
        return Err(checker.invalid("arm.mesh", "and `arm.urdf` are mutually exclusive; set only one"));
    }
    let base = take_text(arm, ["arm", "base_link"], "a link's name", checker)?;
    let tip = take_text(arm, ["arm", "tip_link"], "a link's name", checker)?;
    let has_meshes = take_flag(arm, ["arm", "meshes"], checker)?.unwrap_or(true);
    let file = folder.join(file);
    let from_root = crate::absolute(file.clone());
    let places = MeshPlaces { folder: from_root.parent().unwrap_or(folder), read };
    let (joints, meshes) = read(&file)
        .map_err(|cause| format!("cannot be read ({cause})"))
        .and_then(|text| arm_of(&text, base.as_deref(), tip.as_deref(), Some(&places).filter(|_| has_meshes)))
        .map_err(|problem| checker.invalid("arm.urdf", format!("{}: {problem}", foreign_path(&file))))?;
    arm.insert("joint".to_owned(), Value::Array(joints));
    if !meshes.is_empty() {
        arm.insert("mesh".to_owned(), Value::Array(meshes));
    }
    Ok(true)
}

fn parsed(text: &str) -> Result<Document<'_>, Error> {
    Document::parse_with_options(
        text,
        ParsingOptions { nodes_limit: MOST_NODES, ..ParsingOptions::default() },
    )
}

/// Most prefixes that are declared for a file.
const MOST_PREFIXES: usize = 16;

/// Declares the prefixes of extensions, such as `drake:`, which many files use undeclared: the readers that
/// they are written for know no namespaces.
fn with_prefixes(text: &str) -> String {
    let mut text = text.to_owned();
    for _ in 0..MOST_PREFIXES {
        let Err(Error::UnknownNamespace(prefix, _)) = parsed(&text) else { break };
        let Some(root) = text.find("<robot") else { break };
        text.insert_str(root + "<robot".len(), &format!(" xmlns:{prefix}=\"{prefix}\""));
    }
    text
}

/// The joints from base to tip as tables of `arm.joint`, and the meshes of the links between them as tables
/// of `arm.mesh`.
fn arm_of(
    text: &str,
    base: Option<&str>,
    tip: Option<&str>,
    places: Option<&MeshPlaces>,
) -> Result<(Vec<Value>, Vec<Value>), String> {
    let declared;
    let document = match parsed(text) {
        Err(Error::UnknownNamespace(..)) => {
            declared = with_prefixes(text);
            parsed(&declared)
        }
        other => other,
    }
    .map_err(|cause| format!("is not valid XML ({})", foreign(&cause.to_string())))?;
    let robot = document.root_element();
    if !robot.has_tag_name("robot") {
        let name = foreign(robot.tag_name().name());
        return Err(format!("its root element is `{name}`, expected `robot`; expand xacro files first"));
    }
    let tree = Tree::new(robot)?;
    let base = tree.end(base, "base_link", |link| !tree.parents.contains_key(link))?;
    let above: BTreeSet<&str> = tree.parents.values().map(|joint| joint.parent).collect();
    let tip = tree.end(tip, "tip_link", |link| !above.contains(link))?;
    let chain = tree.chain(base, tip)?;
    let mut meshes = Vec::new();
    if let Some(places) = places {
        let below = chain.iter().map(|joint| (joint.child, Some(joint.name)));
        for (link, joint) in core::iter::once((base, None)).chain(below) {
            for node in named(robot, "link").filter(|node| node.attribute("name") == Some(link)) {
                meshes.extend(urdf_meshes::of_link(node, joint, places)?);
            }
        }
    }
    Ok((chain.into_iter().map(UrdfJoint::table).collect::<Result<_, _>>()?, meshes))
}

/// The robot's child elements with a tag.
fn named<'a>(robot: Node<'a, 'a>, tag: &'static str) -> impl Iterator<Item = Node<'a, 'a>> {
    robot.children().filter(move |node| node.has_tag_name(tag))
}

/// A joint element of the file.
struct UrdfJoint<'a> {
    name: &'a str,
    parent: &'a str,
    child: &'a str,
    node: Node<'a, 'a>,
}

/// All links, and the joint above each.
struct Tree<'a> {
    links: BTreeSet<&'a str>,
    parents: BTreeMap<&'a str, UrdfJoint<'a>>,
}

impl<'a> Tree<'a> {
    fn new(robot: Node<'a, 'a>) -> Result<Self, String> {
        let mut links = BTreeSet::new();
        for link in named(robot, "link").filter_map(|node| node.attribute("name")) {
            if !links.insert(link) {
                return Err(format!("duplicate link `{}`", foreign(link)));
            }
        }
        let mut parents = BTreeMap::new();
        for node in named(robot, "joint") {
            let name = node.attribute("name").ok_or("a joint has no name")?;
            let link_of = |tag: &str| {
                let link = child(node, tag).and_then(|node| node.attribute("link"));
                let link = link.ok_or_else(|| format!("joint `{}` has no {tag} link", foreign(name)))?;
                match links.contains(link) {
                    true => Ok(link),
                    false => Err(format!(
                        "joint `{}` refers to the {tag} link `{}`, which the file does not define",
                        foreign(name),
                        foreign(link)
                    )),
                }
            };
            let (above, below) = (link_of("parent")?, link_of("child")?);
            let joint = UrdfJoint { name, parent: above, child: below, node };
            if let Some(other) = parents.insert(below, joint) {
                return Err(format!(
                    "link `{}` is the child of both joint `{}` and joint `{}`; expected one parent: a serial \
                     arm has no loops",
                    foreign(below),
                    foreign(other.name),
                    foreign(name)
                ));
            }
        }
        Ok(Tree { links, parents })
    }

    /// The link named by a key, or else the only candidate.
    fn end(&self, named: Option<&str>, key: &str, is_end: impl Fn(&str) -> bool) -> Result<&'a str, String> {
        let listed = |links: &mut dyn Iterator<Item = &&str>| {
            links.take(20).map(|link| foreign(link).to_string()).collect::<Vec<_>>().join(", ")
        };
        if let Some(named) = named {
            return self.links.get(named).copied().ok_or_else(|| {
                format!(
                    "has no link `{}` (`arm.{key}`); expected one of {}",
                    foreign(named),
                    listed(&mut self.links.iter())
                )
            });
        }
        let ends: Vec<&str> = self.links.iter().copied().filter(|link| is_end(link)).collect();
        match ends.as_slice() {
            [one] => Ok(one),
            [] => Err(format!("has no candidate for `arm.{key}`: its joints form a loop")),
            several => {
                Err(format!("`arm.{key}` is ambiguous; set it to one of {}", listed(&mut several.iter())))
            }
        }
    }

    /// The joints from `base` to `tip`.
    fn chain(&self, base: &str, tip: &str) -> Result<Vec<&UrdfJoint<'a>>, String> {
        let (mut chain, mut link) = (Vec::new(), tip);
        while link != base {
            let Some(joint) = self.parents.get(link) else {
                return Err(format!("has no chain of joints from `{}` to `{}`", foreign(base), foreign(tip)));
            };
            if chain.len() == MOST_JOINTS {
                return Err(format!(
                    "has more than {MOST_JOINTS} joints from `{}` to `{}`, or a loop",
                    foreign(base),
                    foreign(tip)
                ));
            }
            chain.push(joint);
            link = joint.parent;
        }
        chain.reverse();
        Ok(chain)
    }
}

impl UrdfJoint<'_> {
    /// The joint as a table of `arm.joint`.
    fn table(&self) -> Result<Value, String> {
        let origin = child(self.node, "origin");
        let place = |key: &str, most: f64| match origin.and_then(|node| node.attribute(key)) {
            None => Ok([0.0; 3]),
            Some(text) => three("origin", key, text, most).map_err(|problem| self.says(&problem)),
        };
        let mut table = Table::new();
        table.insert("name".to_owned(), Value::String(self.name.to_owned()));
        table.insert("position_mm".to_owned(), numbers(place("xyz", FARTHEST_M)?.map(|m| m * 1e3)));
        table.insert(
            "roll_pitch_yaw_deg".to_owned(),
            numbers(place("rpy", GREATEST_RAD)?.map(f64::to_degrees)),
        );
        let kind = self.node.attribute("type").unwrap_or_default();
        match kind {
            "fixed" => {}
            "revolute" | "continuous" => self.turn(kind == "continuous", &mut table)?,
            other => {
                let expected =
                    "expected revolute, continuous or fixed: the state holds joint positions as angles";
                return Err(self.says(&format!("is of type `{}`; {expected}", foreign(other))));
            }
        }
        Ok(Value::Table(table))
    }

    /// Sets axis and limits of a revolute joint.
    fn turn(&self, is_endless: bool, table: &mut Table) -> Result<(), String> {
        if child(self.node, "mimic").is_some() {
            return Err(self.says("mimics another joint (`mimic`), which is not supported in an arm"));
        }
        let axis = match child(self.node, "axis").and_then(|node| node.attribute("xyz")) {
            None => [1.0, 0.0, 0.0],
            Some(text) => three("axis", "xyz", text, 1e3).map_err(|problem| self.says(&problem))?,
        };
        let limit = child(self.node, "limit");
        let limit_of = |key: &str, lowest: f64, highest: f64| match limit.and_then(|node| node.attribute(key))
        {
            None => {
                let expected = range(lowest, highest);
                Err(self.says(&format!("has no `limit {key}`; expected {expected}")))
            }
            Some(text) => self.number("limit", key, text, lowest, highest),
        };
        let [lower, upper] = match is_endless {
            true => [-CONTINUOUS_RAD, CONTINUOUS_RAD],
            false => [
                limit_of("lower", -GREATEST_RAD, GREATEST_RAD)?,
                limit_of("upper", -GREATEST_RAD, GREATEST_RAD)?,
            ],
        };
        if upper - lower < LEAST_TURN_RAD {
            let problem = format!(
                "has `limit lower` = {lower} and `upper` = {upper}, expected the upper limit above the lower \
                 one, rad"
            );
            return Err(self.says(&problem));
        }
        // A continuous joint needs no limit (https://wiki.ros.org/urdf/XML/joint).
        let rate = match limit.and_then(|node| node.attribute("velocity")) {
            None if is_endless => 0.0,
            _ => limit_of("velocity", 0.0, f64::INFINITY)?,
        };
        let is_stated = (1e-3..=FASTEST_RAD_PER_S).contains(&rate);
        let rate = if is_stated { rate } else { USUAL_RAD_PER_S };
        table.insert("axis".to_owned(), numbers(axis));
        for (key, value) in [("lower_deg", lower), ("upper_deg", upper), ("max_speed_deg_per_s", rate)] {
            table.insert(key.to_owned(), Value::Float(value.to_degrees()));
        }
        Ok(())
    }

    fn says(&self, problem: &str) -> String {
        format!("joint `{}` {problem}", foreign(self.name))
    }

    fn number(&self, tag: &str, key: &str, text: &str, lowest: f64, highest: f64) -> Result<f64, String> {
        number(tag, key, text, lowest, highest).map_err(|problem| self.says(&problem))
    }
}

/// Parses three numbers of an attribute, each at most `most` in magnitude; errors read as predicates of the
/// element.
pub(crate) fn three(tag: &str, key: &str, text: &str, most: f64) -> Result<[f64; 3], String> {
    let parts: Vec<&str> = text.split_ascii_whitespace().collect();
    let [x, y, z] = parts.as_slice() else {
        return Err(format!("has `{tag} {key}` = \"{}\", expected three numbers", foreign(text)));
    };
    let number = |part: &str| number(tag, key, part, -most, most);
    Ok([number(x)?, number(y)?, number(z)?])
}

fn number(tag: &str, key: &str, text: &str, lowest: f64, highest: f64) -> Result<f64, String> {
    // NaN is in no range and therefore refused too.
    match text.trim().parse::<f64>() {
        Ok(value) if (lowest..=highest).contains(&value) => Ok(value),
        _ => Err(format!("has `{tag} {key}` = {}, expected {}", foreign(text), range(lowest, highest))),
    }
}

fn range(lowest: f64, highest: f64) -> String {
    match highest.is_finite() {
        true => format!("a number from {lowest} to {highest}"),
        false => format!("a number of at least {lowest}"),
    }
}

pub(crate) fn child<'a>(node: Node<'a, 'a>, tag: &str) -> Option<Node<'a, 'a>> {
    node.children().find(|child| child.has_tag_name(tag))
}
