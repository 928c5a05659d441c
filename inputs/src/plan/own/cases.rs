//! What a scene's own tool is put to.

use ipc_types::messages::MAX_TENDONS;
use ipc_types::scene::{Body, BodyMotion, Cuboid};

use super::tool::OwnTool;
use crate::failure::Failure;
use crate::plan::load::{GENTLE_N, Pull};
use crate::plan::measure::against::{Run, path};
use crate::plan::measure::trials::{PLACES, Trial, pulls, tunnels};
use crate::plan::reference::settings_of;

/// The parts of a table: what a scene does not do to its tool is not measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// Weight, loads across the burr, feeds and gentle pulls in free space.
    Gentle,
    /// A wall that it meets.
    Bodies,
    /// Hard pulls, and those of the tendons that no built-in controller pulls alone.
    Hard,
    /// Tunnels in bone.
    Bone,
}

impl Part {
    /// Its name in the hash of a table.
    pub const fn name(self) -> &'static str {
        match self {
            Part::Gentle => "gentle",
            Part::Bodies => "bodies",
            Part::Hard => "hard",
            Part::Bone => "bone",
        }
    }
}

/// The most weight that a scene may state, m/s²: as a load across the burr.
const ACROSS_M_PER_S2: f64 = 100.0;
/// Tensions of the tendons that only clients pull alone, N.
const OTHERS_N: [f64; 2] = [10.0, 60.0];
/// Places of the voxels in which tunnels are drilled: the worst of them counts, so fewer do than where their mean counts.
const OWN_PLACES: usize = 3;

/// Half the wall's thickness, and half its width, mm.
const WALL_MM: [f64; 2] = [5.0, 200.0];
/// A tool that moves less by itself meets no wall, mm.
const LEAST_WAY_MM: f64 = 1.0;

/// A trial, and under what.
#[derive(Debug, Clone, PartialEq)]
pub struct Case {
    /// The trial.
    pub trial: Trial,
    /// Gravity, m/s²; the tool bends toward x and points along z.
    pub gravity_m_per_s2: [f64; 3],
    /// Where the voxels lie, in bone.
    pub place: Option<[f64; 3]>,
    /// A fixed body that the tool meets on its way, in free space.
    pub wall: Option<Wall>,
    /// Whether only settings that bend out of the plane are chosen for a scene of the kind.
    pub is_across: bool,
    /// Whether the load stays the same to the end, so that the tool has to come to rest.
    pub is_held: bool,
}

/// A wall across the way of the burr.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wall {
    /// Where the burr's centre is when it touches the wall, along the side to which the tool bends, mm.
    pub at_mm: f64,
    /// Which way it goes there: 1 or -1.
    pub way: f64,
}

impl Wall {
    /// It, in front of a burr of this radius.
    pub fn body(self, radius_mm: f64) -> Body {
        let [thick_mm, wide_mm] = WALL_MM;
        let centre_mm = self.at_mm + self.way * (radius_mm + thick_mm);
        Body {
            name: "wall".to_owned(),
            cuboid: Some(Cuboid { half_extents_mm: [thick_mm, wide_mm, wide_mm] }),
            ball: None,
            capsule: None,
            motion: BodyMotion::Fixed,
            position_mm: [centre_mm, 0.0, 0.0],
            rotation_vector_deg: [0.0; 3],
            density_kg_per_m3: 1900.0,
            friction: 0.3,
        }
    }
}

impl Case {
    fn free(trial: Trial) -> Case {
        Case { trial, gravity_m_per_s2: [0.0; 3], place: None, wall: None, is_across: false, is_held: false }
    }

    fn held(trial: Trial) -> Case {
        Case { is_held: true, ..Case::free(trial) }
    }

    /// The tool alone, from its start shape on, under this weight.
    fn weighed(seconds: f64, gravity_m_per_s2: [f64; 3]) -> Case {
        let is_across = gravity_m_per_s2[1] != 0.0;
        let trial = Trial { seconds, ..Trial::hold(0.0, 0.0) };
        Case { gravity_m_per_s2, is_across, ..Case::held(trial) }
    }
}

/// The cases of a part.
///
/// # Errors
/// Bad input: the reference refuses the tool.
pub fn cases(tool: &OwnTool, part: Part) -> Result<Vec<Case>, Failure> {
    let pull_s = tool.pull_s()?;
    Ok(match part {
        Part::Gentle => gentle(tool, pull_s),
        Part::Bodies => vec![against_a_wall(tool, pull_s)?],
        Part::Hard => hard(tool, pull_s),
        Part::Bone => bone(tool),
    })
}

fn gentle(tool: &OwnTool, pull_s: f64) -> Vec<Case> {
    let g = tool.weight_m_per_s2();
    let weights = [[g, 0.0, 0.0], [-g, 0.0, 0.0], [0.0, g, 0.0], [ACROSS_M_PER_S2, 0.0, 0.0]];
    let mut cases: Vec<Case> = weights.map(|weight| Case::weighed(pull_s, weight)).into();
    if tool.tendons() == 0 {
        cases.push(Case::free(Trial::feed(0.0, 20.0, 10.0)));
        return cases;
    }
    cases.extend(built_in(Pull::Gentle, pull_s));
    if tool.tendons() > 1 {
        // Skiving pulls the first two alike.
        cases.push(pulled(&[0, 1], GENTLE_N, pull_s));
    }
    cases
}

/// The first tendon's gentle pull, or the swing of a tool that starts straight, against a wall half way; a tool that does not move by itself
/// is pressed on it.
fn against_a_wall(tool: &OwnTool, pull_s: f64) -> Result<Case, Failure> {
    let tension_n = if tool.tendons() == 0 { 0.0 } else { GENTLE_N };
    let trial = Trial { seconds: pull_s, ..Trial::hold(tension_n, 0.0) };
    let case = Case { is_across: true, ..Case::free(trial) };
    let scene = settings_of(&tool.scene(&case.trial, false)?);
    // A tool that the reference loses is refused where it is measured.
    let (burr_m, _) = path(&Run::new(&scene, None)).unwrap_or_default();
    let [starts_mm, ends_mm] =
        [burr_m.first(), burr_m.last()].map(|place| place.map_or(0.0, |place| 1e3 * place.x));
    let way_mm = ends_mm - starts_mm;
    Ok(if way_mm.abs() >= LEAST_WAY_MM {
        Case { wall: Some(Wall { at_mm: 0.5 * (starts_mm + ends_mm), way: way_mm.signum() }), ..case }
    } else {
        let wall = Some(Wall { at_mm: starts_mm, way: 1.0 });
        Case { wall, gravity_m_per_s2: [ACROSS_M_PER_S2, 0.0, 0.0], ..case }
    })
}

fn hard(tool: &OwnTool, pull_s: f64) -> Vec<Case> {
    let mut cases = if tool.tendons() == 0 { Vec::new() } else { built_in(Pull::Hard, pull_s) };
    for one in 0..tool.tendons() {
        let is_alone = one > 0;
        cases.extend(OTHERS_N.into_iter().filter(|_| is_alone).map(|n| pulled(&[one], n, pull_s)));
        cases.extend((0..one).map(|other| pulled(&[other, one], OTHERS_N[0], pull_s)));
    }
    cases
}

/// The standard tool's pulls, with this tool's friction: those that differ in friction alone are one.
fn built_in(pull: Pull, pull_s: f64) -> Vec<Case> {
    let mut cases: Vec<Case> = Vec::new();
    for mut trial in pulls(pull) {
        trial.tool.clear();
        let is_hold = trial.controller.contains("controller.hold");
        if is_hold {
            trial.seconds = pull_s;
        }
        let case = Case { is_held: is_hold, ..Case::free(trial) };
        if !cases.contains(&case) {
            cases.push(case);
        }
    }
    cases
}

fn pulled(tendons: &[usize], tension_n: f64, seconds: f64) -> Case {
    let mut tensions_n = [0.0; MAX_TENDONS];
    tensions_n
        .iter_mut()
        .enumerate()
        .filter(|(place, _)| tendons.contains(place))
        .for_each(|(_, n)| *n = tension_n);
    Case::held(Trial { seconds, ..Trial::pull(tensions_n) })
}

fn bone(tool: &OwnTool) -> Vec<Case> {
    let tunnels = if tool.tendons() == 0 {
        vec![Trial::feed(0.0, 4.0, 20.0), Trial::feed(0.0, 8.0, 20.0)]
    } else {
        // The least and the most of their tensions.
        let [gentlest, _, hardest] = tunnels();
        vec![gentlest, hardest]
    };
    let everywhere = |trial: Trial| {
        PLACES
            .into_iter()
            .take(OWN_PLACES)
            .map(move |place| Case { place: Some(place), ..Case::free(trial.clone()) })
    };
    tunnels.into_iter().flat_map(everywhere).collect()
}
