//! Writes markups for 3D Slicer.

use std::fmt::Write;

use serde_json::{Value, json};

/// The schema that the files follow.
const SCHEMA: &str = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/\
                      markups-schema-v1.0.3.json#";

/// Writes an open curve through points (LPS, mm) as the text of a `.mrk.json`. Slicer draws a smooth line
/// through the points, so they should be close together.
pub fn curve_json(name: &str, points_mm: &[[f64; 3]]) -> String {
    let point = |(index, position): (usize, &[f64; 3])| {
        json!({
            "id": (index + 1).to_string(),
            "label": format!("{name}-{}", index + 1),
            "position": position,
            "selected": true,
            "locked": true,
            "visibility": true,
            "positionStatus": "defined",
        })
    };
    let points: Vec<Value> = points_mm.iter().enumerate().map(point).collect();
    let file = json!({
        "@schema": SCHEMA,
        "markups": [{
            "type": "Curve",
            "coordinateSystem": "LPS",
            "coordinateUnits": "mm",
            "locked": true,
            "fixedNumberOfControlPoints": false,
            "labelFormat": "%N-%d",
            "lastUsedControlPointNumber": points.len(),
            "controlPoints": points,
            "display": {"visibility": true, "glyphScale": 0.5, "pointLabelsVisibility": false},
        }],
    });
    format!("{file:#}\n")
}

/// Writes points (LPS, mm) as the text of a `.fcsv`.
pub fn points_fcsv(name: &str, points_mm: &[[f64; 3]]) -> String {
    let mut text = "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n\
                    # columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
        .to_owned();
    for (index, [x, y, z]) in points_mm.iter().enumerate() {
        let number = index + 1;
        let _ = writeln!(text, "{number},{x:?},{y:?},{z:?},0,0,0,1,1,1,1,{name}-{number},,");
    }
    text
}
