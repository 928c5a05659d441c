//! A drilling plan: entry, bend and target.
//!
//! The tool goes straight from the entry to the bend, in a pilot hole, and from there on a circular arc that
//! is tangent to that line and ends at the target. Without a bend the path is straight: a pilot hole, and the
//! last 10 mm drilled by the tool. A flexible tool does not start a hole in a slanted surface: it slides off.

use crate::error::PlanError;
use crate::markup::{Kind, Markup, Point};
use crate::vector::{across, dot, length, minus, plus, unit};

/// Shortest straight part, mm: points placed by hand are no more accurate, and below it a direction is
/// meaningless.
const SHORTEST_MM: f64 = 1.0;
/// A target this close to the line, mm, is on it.
const ON_THE_LINE_MM: f64 = 0.05;
/// Length of a straight plan that the tool drills itself, mm: such a short part of it protrudes from the
/// pilot hole that it stays on the line.
const LAST_MM: f64 = 10.0;
/// The pilot hole begins this far outside the entry, mm: bone surfaces are rough, and the entry is placed by
/// hand.
const OUTSIDE_MM: f64 = 10.0;

/// A plan. It always has a direction, and its target lies ahead.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plan {
    entry_mm: [f64; 3],
    bend_mm: Option<[f64; 3]>,
    target_mm: [f64; 3],
}

/// An arc tangent to a line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arc {
    /// Its length.
    pub length_mm: f64,
    /// Its angle.
    pub turn_deg: f64,
}

impl Arc {
    /// The arc to a point that lies `ahead_mm` along the tangent and `beside_mm` across it: its chord is at
    /// half its angle.
    pub fn to(ahead_mm: f64, beside_mm: f64) -> Arc {
        let half_rad = libm::atan2(beside_mm, ahead_mm);
        let chord_mm = libm::hypot(ahead_mm, beside_mm);
        let stretch = if half_rad.abs() > 1e-9 { half_rad / libm::sin(half_rad) } else { 1.0 };
        Arc { length_mm: chord_mm * stretch, turn_deg: (2.0 * half_rad).to_degrees() }
    }
}

impl Plan {
    /// Finds the plan in a file's markups: control points named `entry`, `bend` and `target` in any list
    /// (case-insensitive), or the two ends of the only line, or the two or three points of the only curve.
    ///
    /// # Errors
    /// [`PlanError`]: no such points, a duplicate name, points too close to each other, or a target behind
    /// the bend.
    pub fn of(markups: &[Markup]) -> Result<Plan, PlanError> {
        let [entry, bend, target] =
            [named(markups, "entry")?, named(markups, "bend")?, named(markups, "target")?];
        let half = |there, lacking| PlanError::Half { there, lacking, found: found(markups) };
        let (entry, bend, target) = match (entry, target) {
            (Some(entry), Some(target)) => (entry, bend, target),
            (Some(_), None) => return Err(half("entry", "target")),
            (None, Some(_)) => return Err(half("target", "entry")),
            (None, None) => {
                let (entry, middle, target) =
                    ends(markups).ok_or_else(|| PlanError::NoPlan { found: found(markups) })?;
                (entry, bend.or(middle), target)
            }
        };
        let bend = bend.map(|bend| place("bend", bend)).transpose()?;
        Plan::new(place("entry", entry)?, bend, place("target", target)?)
    }

    /// A plan from its points, LPS, mm.
    ///
    /// # Errors
    /// [`PlanError::TooClose`], [`PlanError::Behind`].
    pub fn new(
        entry_mm: [f64; 3],
        bend_mm: Option<[f64; 3]>,
        target_mm: [f64; 3],
    ) -> Result<Plan, PlanError> {
        let apart = |first, second, a, b| {
            let distance_mm = length(minus(b, a));
            // Negated, so that NaN fails.
            if distance_mm >= SHORTEST_MM {
                Ok(())
            } else {
                Err(PlanError::TooClose { first, second, distance_mm })
            }
        };
        match bend_mm {
            None => apart("entry", "target", entry_mm, target_mm)?,
            Some(bend_mm) => {
                apart("entry", "bend", entry_mm, bend_mm)?;
                apart("bend", "target", bend_mm, target_mm)?;
                let ahead_mm = dot(minus(target_mm, bend_mm), unit(minus(bend_mm, entry_mm)));
                if ahead_mm < SHORTEST_MM {
                    return Err(PlanError::Behind { ahead_mm });
                }
            }
        }
        Ok(Plan { entry_mm, bend_mm, target_mm })
    }

    /// Where the tool enters the bone, LPS, mm.
    pub fn entry_mm(&self) -> [f64; 3] {
        self.entry_mm
    }

    /// Where the straight part ends and the curve begins, LPS, mm; `None`: straight to the target.
    pub fn bend_mm(&self) -> Option<[f64; 3]> {
        self.bend_mm
    }

    /// Where the burr's centre ends, LPS, mm.
    pub fn target_mm(&self) -> [f64; 3] {
        self.target_mm
    }

    /// The direction of the straight part, a unit vector.
    pub fn direction(&self) -> [f64; 3] {
        unit(minus(self.bend_mm.unwrap_or(self.target_mm), self.entry_mm))
    }

    /// Where the burr's centre starts: at the bend, or, in a straight plan, 10 mm before the target, but not
    /// before the entry. LPS, mm.
    pub fn burr_start_mm(&self) -> [f64; 3] {
        let straight = || {
            let hole_mm = length(minus(self.target_mm, self.entry_mm)) - LAST_MM;
            plus(self.entry_mm, hole_mm.max(0.0), self.direction())
        };
        self.bend_mm.unwrap_or_else(straight)
    }

    /// Whether the plan has a curve.
    pub fn is_curved(&self) -> bool {
        self.beside().is_some()
    }

    /// The lateral offset of the target from the line, if any.
    fn beside(&self) -> Option<[f64; 3]> {
        let beside = across(minus(self.target_mm, self.burr_start_mm()), self.direction());
        (length(beside) > ON_THE_LINE_MM).then_some(beside)
    }

    /// The side to which the tool bends, a unit vector across the direction: toward the target. A straight
    /// plan can use any: the one nearest to +z (head), or nearest to -y (front) for a direction along z.
    pub fn bend_toward(&self) -> [f64; 3] {
        let direction = self.direction();
        let up = across([0.0, 0.0, 1.0], direction);
        let any = if length(up) > 0.1 { up } else { across([0.0, -1.0, 0.0], direction) };
        unit(self.beside().unwrap_or(any))
    }

    /// The pilot hole, from 10 mm outside the entry to the burr's start; LPS, mm.
    pub fn pilot_hole_mm(&self) -> [[f64; 3]; 2] {
        [plus(self.entry_mm, -OUTSIDE_MM, self.direction()), self.burr_start_mm()]
    }

    /// The midpoint between the burr's start and the target, LPS, mm.
    pub fn middle_mm(&self) -> [f64; 3] {
        let start_mm = self.burr_start_mm();
        plus(start_mm, 0.5, minus(self.target_mm, start_mm))
    }

    /// The arc from `after_mm` ahead of the burr's start to the target; straight for a straight plan.
    pub fn arc(&self, after_mm: f64) -> Arc {
        let ahead_mm = dot(minus(self.target_mm, self.burr_start_mm()), self.direction()) - after_mm;
        Arc::to(ahead_mm, self.beside().map_or(0.0, length))
    }
}

/// The only point with a name.
fn named<'m>(markups: &'m [Markup], name: &'static str) -> Result<Option<&'m Point>, PlanError> {
    let points = markups.iter().flat_map(|markup| &markup.points);
    let all: Vec<&Point> = points.filter(|point| point.label.trim().eq_ignore_ascii_case(name)).collect();
    match all[..] {
        [] => Ok(None),
        [one] => Ok(Some(one)),
        _ => Err(PlanError::Twice { name, count: all.len() }),
    }
}

/// First, middle and last point of the only line or curve.
fn ends(markups: &[Markup]) -> Option<(&Point, Option<&Point>, &Point)> {
    let is_path = |markup: &&Markup| matches!(markup.kind, Kind::Line | Kind::Curve);
    let mut paths = markups.iter().filter(is_path);
    let (Some(only), None) = (paths.next(), paths.next()) else { return None };
    match &only.points[..] {
        [entry, target] => Some((entry, None, target)),
        [entry, bend, target] if only.kind == Kind::Curve => Some((entry, Some(bend), target)),
        _ => None,
    }
}

fn place(name: &'static str, point: &Point) -> Result<[f64; 3], PlanError> {
    point.position_mm.ok_or_else(|| PlanError::Undefined { name, status: point.status.clone() })
}

/// Describes the markups for messages.
fn found(markups: &[Markup]) -> String {
    let one = |markup: &Markup| {
        let kind = match &markup.kind {
            Kind::Points => "list",
            Kind::Line => "line",
            Kind::Curve => "curve",
            Kind::Other(name) => name,
        };
        let labels: Vec<&str> = markup.points.iter().take(6).map(|point| point.label.as_str()).collect();
        format!("{kind} with {} point(s) ({})", markup.points.len(), labels.join(", "))
    };
    markups.iter().map(one).collect::<Vec<_>>().join("; ")
}
