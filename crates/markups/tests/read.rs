//! Tests of markups as written by 3D Slicer, and of what is refused.
#![allow(clippy::unwrap_used, reason = "a test fails by it")]

use markups::{Frame, Kind, MarkupsError, Plan, curve_json, points_fcsv, read};
use proptest::prelude::*;

/// A line as written by Slicer 5.6, shortened to what is relevant to a reader.
fn line(frame: &str) -> String {
    format!(
        r#"{{"@schema": "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#",
        "markups": [{{"type": "Line", {frame} "coordinateUnits": "mm", "locked": false, "labelFormat": "%N-%d",
        "controlPoints": [
            {{"id": "1", "label": "L-1", "description": "", "associatedNodeID": "", "position": [1.5, -2.0, 3.0],
              "orientation": [-1.0, -0.0, -0.0, -0.0, -1.0, -0.0, 0.0, 0.0, 1.0], "selected": true, "locked": false,
              "visibility": true, "positionStatus": "defined"}},
            {{"id": "2", "label": "L-2", "position": [1.5, -2.0, 33.0], "positionStatus": "defined"}}],
        "measurements": [{{"name": "length", "enabled": true, "value": 30.0, "units": "mm"}}]}}]}}"#
    )
}

const LPS: &str = "\"coordinateSystem\": \"LPS\",";

#[test]
fn the_frame_is_read_and_positions_come_out_in_lps() {
    for (frame, expected, start) in [
        (LPS, Frame::Lps, [1.5, -2.0, 3.0]),
        ("\"coordinateSystem\": \"RAS\",", Frame::Ras, [-1.5, 2.0, 3.0]),
    ] {
        let markups = read(&line(frame)).unwrap();
        assert_eq!((markups.len(), &markups[0].kind, markups[0].frame), (1, &Kind::Line, expected));
        assert_eq!(markups[0].points[0].position_mm, Some(start));
    }
    for (frame, expected) in [("0", Frame::Ras), ("1", Frame::Lps), ("RAS", Frame::Ras), ("LPS", Frame::Lps)]
    {
        let text = points_fcsv("F", &[[1.0, 2.0, 3.0]]).replace("= LPS", &format!("= {frame}"));
        let [markup] = &read(&text).unwrap()[..] else { panic!("{text}") };
        let sign = if expected == Frame::Ras { -1.0 } else { 1.0 };
        assert_eq!(markup.frame, expected);
        assert_eq!(markup.points[0].position_mm, Some([sign, 2.0 * sign, 3.0]));
    }
}

/// Assuming a frame could mirror the plan.
#[test]
fn a_frame_that_is_not_said_or_is_no_patients_is_refused_with_the_choices() {
    for text in [
        line(""),
        line("\"coordinateSystem\": \"IJK\","),
        line("\"coordinateSystem\": 1,"),
        points_fcsv("F", &[]).replace("# CoordinateSystem = LPS\n", ""),
        points_fcsv("F", &[]).replace("= LPS", "= IJK"),
        points_fcsv("F", &[]).replace("= LPS", "= 2"),
    ] {
        let said = read(&text).unwrap_err().to_string();
        assert!(said.contains("LPS") && said.contains("RAS") && said.contains("not assumed"), "{said}");
    }
}

#[test]
fn what_is_no_file_of_markups_is_refused_with_its_field() {
    let whole = line(LPS);
    let with = |from: &str, to: &str| {
        assert!(whole.contains(from), "{from}");
        whole.replacen(from, to, 1)
    };
    for (text, said) in [
        (String::new(), "begins with nothing"),
        ("solid".to_owned(), "begins with solid"),
        (whole[..200].to_owned(), "is not JSON"),
        ("{}".to_owned(), "has no `markups`"),
        (r#"{"markups": []}"#.to_owned(), "`markups` is [], expected a list of one or more"),
        (r#"{"markups": 3}"#.to_owned(), "`markups` is 3"),
        (r#"{"markups": [3]}"#.to_owned(), "has no `markups[0].type`"),
        (with("\"mm\",", "\"cm\","), "`markups[0].coordinateUnits` is \"cm\", expected \"mm\""),
        (with("[1.5, -2.0, 3.0]", "[1.5, -2.0]"), "`markups[0].controlPoints[0].position` is [1.5,-2.0]"),
        (with("[1.5, -2.0, 3.0]", "[1.5, -2.0, null]"), "controlPoints[0].position` is [1.5,-2.0,null]"),
        (with("-2.0, 3.0]", "-2.0, 100000.5]"), "each from -100000 to 100000"),
        (with("-2.0, 3.0]", "-2.0, 1e999]"), "is not JSON: number out of range at line"),
        (with("\"position\": [1.5, -2.0, 3.0],", ""), "has no `markups[0].controlPoints[0].position`"),
        (with("\"L-1\"", "7"), "`markups[0].controlPoints[0].label` is 7"),
        (points_fcsv("F", &[[0.0; 3]]).replace("0.0,0.0,0.0", "nan,0,0"), "line 4: x, y, z` is [nan, 0, 0]"),
        (points_fcsv("F", &[[0.0; 3]]).replace("0.0,0.0,0.0", "inf,0,0"), "is [inf, 0, 0]"),
        (points_fcsv("F", &[]) + "1,2.0,3.0\n", "line 4: x, y, z` is [2.0, 3.0, ]"),
        (points_fcsv("F", &[]).replace("label", "name"), "expected columns x, y, z and label"),
        ("[".repeat(100_000), "begins with [["),
        (format!("{{\"markups\": {}", "[".repeat(100_000)), "recursion limit exceeded"),
    ] {
        let error = read(&text).unwrap_err().to_string();
        assert!(error.contains(said), "{error}\nis not\n{said}");
    }
}

#[test]
fn points_that_were_not_placed_have_no_position() {
    let text = line(LPS).replacen("\"positionStatus\": \"defined\"", "\"positionStatus\": \"undefined\"", 1);
    let markups = read(&text).unwrap();
    assert_eq!(markups[0].points[0].position_mm, None);
    let said = Plan::of(&markups).unwrap_err().to_string();
    assert!(
        said.contains("`entry` has no position (Slicer's status is `undefined`, expected `defined`)"),
        "{said}"
    );
}

#[test]
fn cells_of_an_fcsv_may_be_quoted() {
    let text = points_fcsv("F", &[[1.0, 2.0, 3.0]]).replace("F-1", "\"a, \"\"b\"\"\"");
    assert_eq!(read(&text).unwrap()[0].points[0].label, "a, \"b\"");
}

proptest! {
    /// serde_json's fast number parser is off by at most one unit in the last place: 1e-11 mm at 100 m.
    #[test]
    fn what_is_written_reads_as_the_same_places(
        points_mm in prop::collection::vec(prop::array::uniform3(-1e5..1e5), 1..20)
    ) {
        for (text, within) in
            [(curve_json("tip", &points_mm), f64::EPSILON), (points_fcsv("tip", &points_mm), 0.0)]
        {
            let markups = read(&text).unwrap();
            prop_assert_eq!(markups[0].points.len(), points_mm.len());
            for (point, given) in markups[0].points.iter().zip(&points_mm) {
                for (there, here) in point.position_mm.unwrap().iter().zip(given) {
                    prop_assert!((there - here).abs() <= within * here.abs(), "{} {}", there, here);
                }
            }
        }
    }

    #[test]
    fn no_text_makes_it_panic(text in ".{0,200}") {
        if let Err(MarkupsError::Neither { begins }) = read(&text) {
            let is_either = begins.starts_with(['{', '#']);
            prop_assert!(!is_either);
        }
    }
}
