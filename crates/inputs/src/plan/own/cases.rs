//! Load cases on which a scene's own tool is measured.

use ipc_types::messages::MAX_TENDONS;
use ipc_types::scene::{Body, BodyMotion, Cuboid, ToolOuterTube};

use super::tool::{LEAST_ROLL_DEG_PER_S, OwnTool};
use crate::failure::Failure;
use crate::plan::load::{GENTLE_N, Pull};
use crate::plan::measure::against::{Run, path};
use crate::plan::measure::trials::{PLACES, Trial, pulls, tunnels};
use crate::plan::reference::settings_of;

/// Parts of a table: only loads that occur in the scene are measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CaseGroup {
    /// Weight, loads on the burr, feeds and gentle pulls in free space.
    Gentle,
    /// A wall in the tool's path.
    Bodies,
    /// Hard pulls, and pulls of tendons that no built-in controller pulls alone.
    Hard,
    /// Tunnels in bone.
    Bone,
}

impl CaseGroup {
    /// Its name in the hash of a table.
    pub const fn name(self) -> &'static str {
        match self {
            CaseGroup::Gentle => "gentle",
            CaseGroup::Bodies => "bodies",
            CaseGroup::Hard => "hard",
            CaseGroup::Bone => "bone",
        }
    }
}

/// Largest gravity that a scene can set, m/s²: a load across the burr.
const ACROSS_M_PER_S2: f64 = 100.0;
/// Tensions of the tendons that only clients pull alone, N.
const OTHERS_N: [f64; 2] = [10.0, 60.0];
/// Number of voxel grid offsets for tunnels: fewer suffice for the worst of them than for their mean.
const OWN_PLACES: usize = 3;

/// Longest time for a tool to slide out of its outer tube, s.
const LONGEST_SLIDE_S: f64 = 4.0;
/// Time of a tube's drive beyond its travel at full speed, s, and half of that of a roll.
const DRIVE_S: f64 = 0.15;
/// Feeds of a tool without tendons in bone, mm/s.
const FEEDS_MM_PER_S: [f64; 2] = [4.0, 8.0];
/// Length of its tunnel, mm.
const TUNNEL_MM: f64 = 20.0;

/// Half the wall's thickness, and half its width, mm.
const WALL_MM: [f64; 2] = [5.0, 200.0];
/// A tool that moves less than this on its own does not reach the wall, mm.
const LEAST_WAY_MM: f64 = 1.0;

/// A trial, and its loads.
#[derive(Debug, Clone, PartialEq)]
pub struct Case {
    /// The trial.
    pub trial: Trial,
    /// Gravity, m/s²; the tool bends toward x and points along z.
    pub gravity_m_per_s2: [f64; 3],
    /// Offset of the voxel grid, in bone.
    pub place: Option<[f64; 3]>,
    /// A fixed body in the tool's path, in free space.
    pub wall: Option<Wall>,
    /// Whether scenes of this kind can only use models that bend out of the plane.
    pub is_across: bool,
    /// Whether the load is constant to the end, so that the tool must come to rest.
    pub is_held: bool,
}

/// A wall across the burr's path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wall {
    /// Position of the burr's centre when it touches the wall, along the side to which the tool bends, mm.
    pub at_mm: f64,
    /// Direction of motion there: 1 or -1.
    pub way: f64,
}

impl Wall {
    /// The wall as a body in front of a burr of a given radius.
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
            material: None,
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

    /// The tool alone, from its start shape, under a given gravity.
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
pub fn cases(tool: &OwnTool, part: CaseGroup) -> Result<Vec<Case>, Failure> {
    let pull_s = tool.pull_s()?;
    Ok(match part {
        CaseGroup::Gentle => gentle(tool, pull_s),
        CaseGroup::Bodies => vec![against_a_wall(tool, pull_s)?],
        CaseGroup::Hard => hard(tool, pull_s),
        CaseGroup::Bone => bone(tool),
    })
}

fn gentle(tool: &OwnTool, pull_s: f64) -> Vec<Case> {
    let g = tool.weight_m_per_s2();
    let weights = [[g, 0.0, 0.0], [-g, 0.0, 0.0], [0.0, g, 0.0], [ACROSS_M_PER_S2, 0.0, 0.0]];
    if let Some(outer) = tool.outer_tube() {
        // Fully deployed, where it is most compliant; half a turn keeps its plane, a quarter turn does not.
        let out = |roll_deg: f64, weight: [f64; 3]| {
            let is_across = weight[1] != 0.0 || roll_deg == 90.0;
            let trial = slid(outer, roll_deg, pull_s);
            Case { gravity_m_per_s2: weight, is_across, ..Case::held(trial) }
        };
        let turned = [180.0, 90.0].map(|roll_deg| out(roll_deg, weights[0]));
        return weights.map(|weight| out(0.0, weight)).into_iter().chain(turned).collect();
    }
    let mut cases: Vec<Case> = weights.map(|weight| Case::weighed(pull_s, weight)).into();
    if tool.tendons() == 0 {
        cases.push(Case::free(Trial::feed(0.0, 20.0, 10.0)));
        return cases;
    }
    cases.extend(built_in(Pull::Gentle, pull_s));
    if tool.tendons() > 1 {
        // Skiving pulls the first two equally.
        cases.push(pulled(&[0, 1], GENTLE_N, pull_s));
    }
    cases
}

/// Deploys the whole travel out of the outer tube, then rests.
fn slid(outer: &ToolOuterTube, roll_deg: f64, pull_s: f64) -> Trial {
    let feed_mm_per_s = outer.speed_mm_per_s.max(outer.travel_mm / LONGEST_SLIDE_S);
    let roll_s = roll_deg / outer.roll_speed_deg_per_s.max(LEAST_ROLL_DEG_PER_S);
    let seconds = roll_s + outer.travel_mm / feed_mm_per_s + 2.0 * DRIVE_S + pull_s;
    Trial::deploy(outer.travel_mm, feed_mm_per_s, roll_deg, seconds)
}

/// Pushes the tool against a wall half way: by the first tendon's gentle pull, or by the swing of a tool that
/// starts straight; a tool that does not move on its own is pressed onto it.
fn against_a_wall(tool: &OwnTool, pull_s: f64) -> Result<Case, Failure> {
    let tension_n = if tool.tendons() == 0 { 0.0 } else { GENTLE_N };
    let trial = match tool.outer_tube() {
        Some(outer) => slid(outer, 0.0, pull_s),
        None => Trial { seconds: pull_s, ..Trial::hold(tension_n, 0.0) },
    };
    let case = Case { is_across: true, ..Case::free(trial) };
    let scene = settings_of(&tool.scene(&case.trial, false)?);
    // A tool that the reference loses is refused during measuring.
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

/// The standard tool's pulls, with this tool's friction: those that differ only in friction are merged.
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
    let tunnels = if let Some(outer) = tool.outer_tube() {
        let length_mm = outer.travel_mm.min(TUNNEL_MM);
        let slid = |feed_mm_per_s: f64| {
            let seconds = length_mm / feed_mm_per_s + 2.0 * DRIVE_S + 0.5;
            Trial::deploy(length_mm, feed_mm_per_s, 0.0, seconds)
        };
        FEEDS_MM_PER_S.map(slid).into()
    } else if tool.tendons() == 0 {
        FEEDS_MM_PER_S.map(|feed_mm_per_s| Trial::feed(0.0, feed_mm_per_s, TUNNEL_MM)).into()
    } else {
        // The smallest and largest of their tensions.
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
