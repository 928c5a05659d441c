//! The actual path of the burr, and its deviation from the planned path.

use ipc_types::messages::State;
use markups::vector::{dot, length, minus, plus};

/// A position of the burr's centre.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathPoint {
    /// Tick.
    pub tick: u64,
    /// Simulated time.
    pub time_s: f64,
    /// Position, LPS.
    pub burr_mm: [f64; 3],
}

/// A position relative to the planned path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deviation {
    /// Position of the burr.
    pub place: PathPoint,
    /// Length of the planned path up to the nearest point.
    pub along_mm: f64,
    /// Distance from the nearest point.
    pub deviation_mm: f64,
}

/// The burr's path, sampled at a minimum distance; the first and last positions are always included.
#[derive(Debug)]
pub struct PathRecorder {
    step_mm: f64,
    places: Vec<PathPoint>,
    last: Option<PathPoint>,
}

impl PathRecorder {
    /// Creates an empty path.
    pub fn new(step_mm: f64) -> PathRecorder {
        PathRecorder { step_mm, places: Vec::new(), last: None }
    }

    /// Adds the next state.
    pub fn see(&mut self, state: &State) {
        let burr_mm = state.t_world_burr.position_m.map(|x| 1e3 * x);
        let place = PathPoint { tick: state.tick, time_s: state.sim_time_s, burr_mm };
        let is_far = |kept: &PathPoint| length(minus(burr_mm, kept.burr_mm)) >= self.step_mm;
        if self.places.last().is_none_or(is_far) {
            self.places.push(place);
        }
        self.last = Some(place);
    }

    /// Returns the samples so far.
    pub fn so_far(&self) -> &[PathPoint] {
        &self.places
    }

    /// Returns all samples.
    pub fn places(mut self) -> Vec<PathPoint> {
        if let Some(last) = self.last.filter(|last| self.places.last() != Some(last)) {
            self.places.push(last);
        }
        self.places
    }
}

/// Returns the deviations of the burr from the planned path during insertion, that is, up to the position
/// farthest along the path; what follows is the retraction.
pub fn deviations(planned_mm: &[[f64; 3]], places: &[PathPoint]) -> Vec<Deviation> {
    let mut all: Vec<Deviation> = places.iter().filter_map(|place| deviation(planned_mm, *place)).collect();
    let farthest = (0..all.len()).max_by(|a, b| all[*a].along_mm.total_cmp(&all[*b].along_mm));
    all.truncate(farthest.map_or(0, |farthest| farthest + 1));
    all
}

/// Returns the deviation from the nearest point of the path's segments.
fn deviation(planned_mm: &[[f64; 3]], place: PathPoint) -> Option<Deviation> {
    let mut passed_mm = 0.0;
    let mut nearest: Option<Deviation> = None;
    for piece in planned_mm.windows(2) {
        let (way, away) = (minus(piece[1], piece[0]), minus(place.burr_mm, piece[0]));
        let long_mm = length(way);
        let share = if long_mm > 0.0 { (dot(away, way) / (long_mm * long_mm)).clamp(0.0, 1.0) } else { 0.0 };
        let deviation_mm = length(plus(away, -share, way));
        if nearest.is_none_or(|nearest| deviation_mm < nearest.deviation_mm) {
            nearest = Some(Deviation { place, along_mm: passed_mm + share * long_mm, deviation_mm });
        }
        passed_mm += long_mm;
    }
    nearest
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 52 mm along +z, then a quarter circle of 25 mm radius.
    fn path() -> Vec<[f64; 3]> {
        let line = (0..=208).map(|step| [0.0, 0.0, -10.0 + 0.25 * f64::from(step)]);
        let arc = (1..=100).map(|step| (core::f64::consts::FRAC_PI_2 * f64::from(step) / 100.0).sin_cos());
        line.chain(arc.map(|(sin, cos)| [25.0 - 25.0 * cos, 0.0, 42.0 + 25.0 * sin])).collect()
    }

    fn at(burr_mm: [f64; 3]) -> PathPoint {
        PathPoint { tick: 0, time_s: 0.0, burr_mm }
    }

    #[test]
    fn a_deviation_is_the_distance_from_the_nearest_point_of_the_way_in() {
        let places =
            [at([0.0, 0.3, 20.0]), at([0.0, 0.0, 41.0]), at([25.0 - 25.5, 0.0, 42.0]), at([0.0, 1.0, 30.0])];
        let found = deviations(&path(), &places);
        let figures: Vec<[f64; 2]> = found.iter().map(|one| [one.along_mm, one.deviation_mm]).collect();
        let expected = [[30.0, 0.3], [51.0, 0.0], [52.0, 0.5]];
        assert_eq!(figures.len(), 3, "without the way back: {figures:?}");
        for (found, expected) in figures.iter().flatten().zip(expected.iter().flatten()) {
            assert!((found - expected).abs() < 1e-9, "{figures:?}");
        }
    }

    #[test]
    fn a_travelled_path_keeps_a_place_a_step_and_both_ends() {
        let mut path = PathRecorder::new(0.1);
        for tick in 0..=100_u64 {
            let mut state = State::zeroed();
            (state.tick, state.t_world_burr.position_m[0]) = (tick, tick as f64 * 1.3e-5);
            path.see(&state);
        }
        let places = path.places();
        let ticks: Vec<u64> = places.iter().map(|place| place.tick).collect();
        assert_eq!(ticks[..3], [0, 8, 16]);
        assert_eq!(ticks.last(), Some(&100));
    }
}
