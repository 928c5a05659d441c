//! `trabecula plan path`: searches approaches to a scene's target for those that keep away from its
//! structures and remove little bone, by simulating them in this process.
//!
//! Candidates come from a Sobol sequence. Their planned paths are compared with the structures first, and
//! only the promising ones are simulated: half of the budget all over the bounds, the rest in two rounds
//! around the best found so far. The result depends on the scene's files and the settings alone, not on the
//! number of cores.

mod figure;
mod offsets;
mod outcome;
mod risk;
mod screen;

use std::collections::{BTreeMap, HashSet};

use ipc_types::process::EXIT_BAD_INPUT;
use ipc_types::scene::{MAX_STRUCTURES, Scene, StructureRole};
use serde::Serialize;
use sim::{SharedScene, SimError, on_all_cores};
use sweep::{pareto_front, pareto_order, sobol_point};

use crate::failure::{EXIT_INTERRUPTED, Failure};
use crate::launcher::volume_source::VolumeFiles;
use crate::plan_edit::approach::{approached, portable, with_outside};
use crate::prediction::Prediction;
use crate::scenes::SceneSource;
use offsets::{DIMENSIONS, drilling, offset};
use screen::Screen;

pub use figure::draw;
pub use offsets::{Bounds, Offsets};
pub use outcome::{Fault, Outcome};
pub use risk::{Risk, Uncertainty};

/// Points of the sequence for each candidate to simulate.
const DRAWS: usize = 16;
/// Shares of the bounds that the rounds search, around the best so far after the first.
const ROUNDS: [f64; 3] = [1.0, 0.3, 0.1];
/// Name and margin of the structure that is added to a scene without one. A burr of 6.5 mm that keeps 5 mm
/// leaves a wall as thick as 1.5 of its radii.
const OUTSIDE: (&str, f64) = ("outside_of_bone", 5.0);

/// A simulated approach.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Candidate {
    /// By how much it differs from the scene.
    pub offsets: Offsets,
    /// What it would do.
    pub outcome: Outcome,
    /// Its scene.
    #[serde(skip)]
    pub text: String,
}

/// Settings of a search.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Largest offsets.
    pub bounds: Bounds,
    /// Largest number of approaches to simulate, the scene's own included.
    pub candidates: usize,
    /// Seed of the sequence.
    pub seed: u64,
    /// Which files the scene's volume may name.
    pub volume_files: VolumeFiles,
}

/// A search for approaches.
pub struct Search<'a> {
    /// Names the scene, and the folder of its relative paths.
    source: SceneSource,
    /// The scene's text with absolute paths.
    text: String,
    scene: Scene,
    /// Whether the outside of the bone was added to the scene's structures.
    pub has_added_outside: bool,
    limits: [f64; DIMENSIONS],
    settings: Settings,
    is_to_end: &'a (dyn Fn() -> bool + Sync),
    shared: std::sync::Arc<SharedScene>,
}

impl<'a> Search<'a> {
    /// Loads the scene of a search.
    ///
    /// # Errors
    /// Bad input (2): the scene is refused or has nothing to search for.
    pub fn new(
        source: &SceneSource,
        settings: Settings,
        is_to_end: &'a (dyn Fn() -> bool + Sync),
    ) -> Result<Search<'a>, Failure> {
        let original = source.load()?;
        refuse(source, &original)?;
        let folder = source.argument().map(output_file::folder_of).unwrap_or(std::path::Path::new("."));
        let edited = portable(&source.text()?, &original, folder);
        let has_added_outside =
            !original.structure.iter().any(|structure| structure.role == StructureRole::Avoid);
        let edited = edited.and_then(|text| match has_added_outside {
            true => with_outside(&text, &free_name(&original), OUTSIDE.1),
            false => Ok(text),
        });
        let text = edited.map_err(|cause| Failure::bad_input(format!("{source}: {cause}")))?;
        let files = settings.volume_files;
        let shared =
            SharedScene::of_source(None, changed(source, &text), &[], None, files).map_err(failure_of)?;
        let scene = changed(source, &text).load()?;
        let limits = drilling(&scene).map_or([0.0; DIMENSIONS], |plan| settings.bounds.limits(&scene, plan));
        Ok(Search {
            source: source.clone(),
            text,
            scene,
            has_added_outside,
            limits,
            settings,
            is_to_end,
            shared,
        })
    }

    /// Returns the scene.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Simulates the candidates; the first one is the scene itself. Calls `tell` after each round
    /// that adds some.
    ///
    /// # Errors
    /// Out of memory (1); Ctrl-C (130).
    pub fn run(&self, tell: &dyn Fn(&[Candidate])) -> Result<Vec<Candidate>, Failure> {
        let screen = Screen::of(&self.scene);
        let refined = self.settings.candidates / 4;
        let mut found: Vec<Candidate> = Vec::new();
        let mut known = HashSet::from([Offsets::default().key()]);
        let mut next = 0;
        for (round, share) in ROUNDS.into_iter().enumerate() {
            let (parents, count) = match round {
                0 => (vec![Offsets::default()], self.settings.candidates - 2 * refined),
                _ => (parents(&found), refined),
            };
            let mut offsets = self.pick(&screen, &parents, (share, count), &mut next)?;
            offsets.retain(|offsets| known.insert(offsets.key()));
            if round == 0 {
                offsets.insert(0, Offsets::default());
                offsets.truncate(count);
            }
            let new = on_all_cores("path", &offsets, |offsets| self.candidate(*offsets))?;
            let count = found.len();
            found.extend(new.into_iter().flatten());
            if found.len() > count {
                tell(&found);
            }
        }
        Ok(found)
    }

    /// Chooses offsets around parents: half of them by their planned paths, the rest as they come.
    ///
    /// # Errors
    /// Ctrl-C (130).
    fn pick(
        &self,
        screen: &Screen,
        parents: &[Offsets],
        (share, count): (f64, usize),
        next: &mut u64,
    ) -> Result<Vec<Offsets>, Failure> {
        let draw = |index: usize| {
            let unit: [f64; DIMENSIONS] = sobol_point(self.settings.seed, *next + index as u64);
            let parent = parents[index % parents.len()].numbers();
            Offsets::of(std::array::from_fn(|i| {
                let limit = self.limits[i];
                // Without negative zeros.
                (parent[i] + share * limit * (2.0 * unit[i] - 1.0)).clamp(-limit, limit) + 0.0
            }))
        };
        let draws = DRAWS * count;
        let mut planned: Vec<(Offsets, [f64; 2])> = Vec::new();
        for offsets in (0..draws).map(draw) {
            self.refuse_interrupted()?;
            planned.extend(screen.objectives(&offsets).map(|score| (offsets, score)));
        }
        *next += draws as u64;
        let scores: Vec<[f64; 2]> = planned.iter().map(|(_, score)| *score).collect();
        let mut chosen = pareto_order(&scores);
        chosen.truncate(count.div_ceil(2));
        let best: HashSet<usize> = chosen.iter().copied().collect();
        chosen.extend((0..planned.len()).filter(|index| !best.contains(index)));
        chosen.truncate(count);
        Ok(chosen.into_iter().map(|index| planned[index].0).collect())
    }

    /// Simulates a candidate; `None` if it cannot reach the target.
    fn candidate(&self, offsets: Offsets) -> Result<Option<Candidate>, Failure> {
        let text = match offsets == Offsets::default() {
            true => self.text.clone(),
            false => {
                let Some(scene) = offset(&self.scene, &offsets) else { return Ok(None) };
                approached(&self.text, &self.scene, &scene).map_err(Failure::failed)?
            }
        };
        let outcome = self.outcome(&text, &[])?;
        Ok(Some(Candidate { offsets, outcome, text }))
    }

    fn refuse_interrupted(&self) -> Result<(), Failure> {
        let message = "interrupted; nothing was written".to_owned();
        if (self.is_to_end)() { Err(Failure { message, code: EXIT_INTERRUPTED }) } else { Ok(()) }
    }

    /// Simulates a scene with keys set.
    fn outcome(&self, text: &str, settings: &[String]) -> Result<Outcome, Failure> {
        let (source, files) = (changed(&self.source, text), self.settings.volume_files);
        let refused = |failure: Failure| match failure.code {
            EXIT_BAD_INPUT => Ok(Outcome::refused(failure.message)),
            _ => Err(failure),
        };
        let shared = match SharedScene::of_source(Some(&self.shared), source, settings, None, files) {
            Ok(shared) => shared,
            Err(error) => return refused(failure_of(error)),
        };
        let predicted = Prediction::unless(shared.scene(), shared.ct().cloned(), &mut || (self.is_to_end)());
        self.refuse_interrupted()?;
        predicted.map_or_else(refused, |prediction| Ok(Outcome::of(shared.scene(), &prediction)))
    }
}

fn failure_of(error: SimError) -> Failure {
    match error {
        SimError::Input(failure) => failure,
        other => Failure::by_kind(!other.is_of_the_machine(), other),
    }
}

/// Returns a scene with another text, whose messages name the original.
fn changed(source: &SceneSource, text: &str) -> SceneSource {
    SceneSource::Changed { source: Box::new(source.clone()), text: text.to_owned() }
}

/// Refuses a scene without anything to search for.
fn refuse(source: &SceneSource, scene: &Scene) -> Result<(), Failure> {
    let bad = |problem: &str| Err(Failure::bad_input(format!("{source}: {problem}")));
    let Some(plan) = drilling(scene) else {
        return bad("missing `[controller.curved_drilling]`, the only controller whose path can be planned");
    };
    if let Some(other) = scene.controller.iter().find(|other| other.is_program() || other.external) {
        return bad(&format!("controller `{}` is not built in, so its run cannot be simulated", other.name));
    }
    let has_region = scene.structure.iter().any(|structure| structure.role == StructureRole::Target);
    if plan.target_mm.is_none() && !has_region {
        return bad("no target; set `controller.curved_drilling.target_mm`, or `role = \"target\"` of a \
             `[[structure]]`");
    }
    let is_avoided = |structure: &ipc_types::scene::Structure| structure.role == StructureRole::Avoid;
    if scene.volume.is_none() && !scene.structure.iter().any(is_avoided) {
        return bad("nothing to keep away from; add a `[[structure]]` or a `[volume]`");
    }
    if scene.structure.len() == MAX_STRUCTURES && !scene.structure.iter().any(is_avoided) {
        return bad(&format!(
            "nothing to keep away from: all {MAX_STRUCTURES} structures are targets, so the outside of the \
             bone cannot be added; remove one"
        ));
    }
    Ok(())
}

/// Returns a name for the structure that is added.
fn free_name(scene: &Scene) -> String {
    let is_free = |name: &String| scene.structure.iter().all(|structure| structure.name != *name);
    let numbered = (2..).map(|number| format!("{}_{number}", OUTSIDE.0));
    std::iter::once(OUTSIDE.0.to_owned()).chain(numbered).find(is_free).unwrap_or_default()
}

/// Returns the offsets to search around: those of the front, or else of the path that ends closest to the
/// target.
fn parents(found: &[Candidate]) -> Vec<Offsets> {
    let front = front(found);
    if !front.is_empty() {
        return front.into_iter().map(|index| found[index].offsets).collect();
    }
    let error_mm = |candidate: &&Candidate| candidate.outcome.target_error_mm.unwrap_or(f64::INFINITY);
    let closest = found.iter().min_by(|a, b| error_mm(a).total_cmp(&error_mm(b)));
    vec![closest.map_or_else(Offsets::default, |candidate| candidate.offsets)]
}

/// Returns the indices of the candidates that no other one beats in clearance and bone removed, by falling
/// clearance.
pub fn front(found: &[Candidate]) -> Vec<usize> {
    let objectives = |candidate: &Candidate| candidate.outcome.objectives().unwrap_or([f64::NAN; 2]);
    pareto_front(&found.iter().map(objectives).collect::<Vec<_>>())
}

/// Returns at most `count` members of a front, spread evenly, with both ends.
pub fn spread(front: &[usize], count: usize) -> Vec<usize> {
    if front.len() <= count {
        return front.to_vec();
    }
    let last = front.len() - 1;
    let place = |i: usize| if count == 1 { 0 } else { (i * last + (count - 1) / 2) / (count - 1) };
    (0..count).map(|i| front[place(i)]).collect()
}

/// Counts the candidates by their faults.
pub fn faults(found: &[Candidate]) -> BTreeMap<Fault, usize> {
    let mut counts = BTreeMap::new();
    for fault in found.iter().filter_map(|candidate| candidate.outcome.fault) {
        *counts.entry(fault).or_default() += 1;
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_added_structure_has_a_free_name_and_drawing_can_be_interrupted() {
        use crate::scenes::BuiltIn;
        let femur = BuiltIn::Femur.text();
        let target = "[[structure]]\nname = \"outside_of_bone\"\nrole = \"target\"\n\
                      ball = { centre_mm = [0.0, 0.0, 0.0], radius_mm = 1.0 }\n";
        let source = changed(&SceneSource::BuiltIn(BuiltIn::Femur), &format!("{femur}\n{target}"));
        let bounds =
            Bounds { entry_mm: 3.0, tilt_deg: 5.0, bend_mm: 2.0, tension_percent: 10.0, feed_mm: 1.0 };
        let settings = Settings { bounds, candidates: 4, seed: 1, volume_files: VolumeFiles::default() };
        let search = Search::new(&source, settings, &|| true).unwrap();
        let names: Vec<&str> = search.scene().structure.iter().map(|it| it.name.as_str()).collect();
        assert_eq!(names, ["outside_of_bone", "outside_of_bone_2"]);
        let screen = Screen::of(search.scene());
        let drawn = search.pick(&screen, &[Offsets::default()], (1.0, 4), &mut 0);
        assert_eq!(drawn.unwrap_err().code, EXIT_INTERRUPTED);
    }

    #[test]
    fn a_long_front_is_thinned_evenly_with_both_ends() {
        let front: Vec<usize> = (10..21).collect();
        assert_eq!(spread(&front, 3), [10, 15, 20]);
        assert_eq!(spread(&front, 5), [10, 13, 15, 18, 20]);
        assert_eq!(spread(&front, 1), [10]);
        assert_eq!(spread(&front[..2], 5), [10, 11]);
    }
}
