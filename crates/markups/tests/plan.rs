//! Tests of plans in markups, and the values derived from them.
#![allow(clippy::unwrap_used, reason = "a test fails by it")]

use markups::{Arc, Plan, PlanError, read};
use proptest::prelude::*;

fn points(labels: &[(&str, [f64; 3])]) -> String {
    let of = |(label, [x, y, z]): &(&str, [f64; 3])| {
        format!("{{\"label\": \"{label}\", \"position\": [{x:?}, {y:?}, {z:?}]}}")
    };
    let points: Vec<String> = labels.iter().map(of).collect();
    format!(
        "{{\"type\": \"KIND\", \"coordinateSystem\": \"LPS\", \"controlPoints\": [{}]}}",
        points.join(", ")
    )
}

/// Markups by name, with labelled points, mm.
type Named<'a> = (&'a str, &'a [(&'a str, [f64; 3])]);

fn plan(markups: &[Named<'_>]) -> Result<Plan, PlanError> {
    let each: Vec<String> =
        markups.iter().map(|(kind, labels)| points(labels).replace("KIND", kind)).collect();
    Plan::of(&read(&format!("{{\"markups\": [{}]}}", each.join(", "))).unwrap())
}

const ENTRY: [f64; 3] = [0.0, 0.0, 0.0];
const BEND: [f64; 3] = [0.0, 0.0, 40.0];
const TARGET: [f64; 3] = [3.0, 4.0, 55.0];

#[test]
fn the_same_plan_is_found_by_names_in_any_list_and_by_the_order_of_a_curve() {
    let expected = Plan::new(ENTRY, Some(BEND), TARGET).unwrap();
    let other = ("F-4", [9.0; 3]);
    let lists: [&[Named<'_>]; 4] = [
        &[("Fiducial", &[("Target", TARGET), ("ENTRY ", ENTRY), other, ("bend", BEND)])],
        &[("Fiducial", &[("bend", BEND)]), ("Line", &[("L-1", ENTRY), ("L-2", TARGET)])],
        &[("Curve", &[("C-1", ENTRY), ("C-2", BEND), ("C-3", TARGET)])],
        &[
            ("Plane", &[("P-1", [7.0; 3])]),
            ("Curve", &[("target", TARGET), ("bend", BEND), ("entry", ENTRY)]),
        ],
    ];
    for list in lists {
        assert_eq!(plan(list), Ok(expected));
    }
}

#[test]
fn what_is_no_plan_is_refused_with_what_there_is() {
    for (list, said) in [
        (&[("Fiducial", &[("F-1", ENTRY), ("F-2", TARGET)][..])][..], "list with 2 point(s) (F-1, F-2)"),
        (&[("Fiducial", &[("entry", ENTRY), ("F-2", TARGET)])], "named `entry` but none named `target`"),
        (&[("Fiducial", &[("target", ENTRY)])], "named `target` but none named `entry`"),
        (
            &[("Fiducial", &[("entry", ENTRY), ("Entry", BEND), ("target", TARGET)])],
            "has 2 control points named `entry`",
        ),
        (&[("Line", &[("L-1", ENTRY)])], "line with 1 point(s) (L-1)"),
        (&[("Line", &[("a", ENTRY), ("b", BEND)]), ("Line", &[("c", ENTRY), ("d", BEND)])], "holds no plan"),
        (&[("Curve", &[("a", ENTRY), ("b", BEND), ("c", TARGET), ("d", TARGET)])], "curve with 4 point(s)"),
        (&[("Line", &[("a", ENTRY), ("b", [0.0, 0.0, 0.5])])], "`entry` and `target` are 0.500 mm apart"),
        (
            &[("Curve", &[("a", ENTRY), ("b", BEND), ("c", [0.0, 9.0, 39.0])])],
            "lies -1.00 mm ahead of `bend`",
        ),
    ] {
        let error = plan(list).unwrap_err().to_string();
        assert!(error.contains(said), "{error}\nis not\n{said}");
    }
}

#[test]
fn a_curve_gives_every_place_of_a_scene() {
    let plan = Plan::new(ENTRY, Some(BEND), TARGET).unwrap();
    assert_eq!((plan.burr_start_mm(), plan.direction()), (BEND, [0.0, 0.0, 1.0]));
    assert_eq!(plan.bend_toward(), [0.6, 0.8, 0.0]);
    assert_eq!(plan.pilot_hole_mm(), [[0.0, 0.0, -10.0], BEND]);
    assert_eq!(plan.middle_mm(), [1.5, 2.0, 47.5]);
    // 15 ahead and 5 beside: a circle of radius (15² + 5²) / (2 · 5) = 25, whose chord subtends 2 atan(1/3).
    let turn_rad = 2.0 * (1.0_f64 / 3.0).atan();
    let arc = plan.arc(0.0);
    assert!(
        (arc.length_mm - 25.0 * turn_rad).abs() < 1e-9 && (arc.turn_deg - turn_rad.to_degrees()).abs() < 1e-9
    );
}

/// Regression: without a pilot hole, whether the tool slid off the cortex depended on the third decimal of
/// the entry.
#[test]
fn a_straight_plan_has_a_pilot_hole_up_to_its_last_10_mm_and_may_bend_anywhere() {
    let dot = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    for (target, hole_mm) in [
        ([0.0, 0.0, 30.0], 20.0),
        ([0.0, 0.0, -30.0], 20.0),
        ([30.0, 0.0, 0.0], 20.0),
        // With such a short plan, the tool drills all of it, from the entry.
        ([1.0, -2.0, 3.0], 0.0),
    ] {
        let plan = Plan::new(ENTRY, None, target).unwrap();
        let (d, b, s) = (plan.direction(), plan.bend_toward(), plan.burr_start_mm());
        assert!(dot(d, b).abs() < 1e-12 && (dot(b, b) - 1.0).abs() < 1e-12, "{target:?}: {d:?} {b:?}");
        assert!((dot(s, d) - hole_mm).abs() < 1e-12 && !plan.is_curved(), "{target:?}: {s:?}");
        assert_eq!(plan.pilot_hole_mm(), [d.map(|x| -10.0 * x), s]);
        assert!((plan.arc(0.0).length_mm - dot(target, target).sqrt() + hole_mm).abs() < 1e-12);
    }
}

proptest! {
    /// The circle through the tangent's foot and the point: its chord and angle give the arc in closed form,
    /// r θ.
    #[test]
    fn an_arc_is_radius_times_angle(ahead_mm in 0.1..100.0, beside_mm in 1e-3..100.0) {
        let arc = Arc::to(ahead_mm, beside_mm);
        let radius_mm = (ahead_mm * ahead_mm + beside_mm * beside_mm) / (2.0 * beside_mm);
        let expected_mm = radius_mm * arc.turn_deg.to_radians();
        // atan2 and the quotient round by a few parts in 1e16 each.
        prop_assert!(
            (arc.length_mm - expected_mm).abs() < 1e-12 * expected_mm,
            "{} {expected_mm}", arc.length_mm
        );
    }
}
