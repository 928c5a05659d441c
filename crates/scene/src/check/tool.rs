//! Checks how the keys of a tool description relate to each other.

use messages::MAX_JOINTS;

use super::Checker;
use crate::cutter::{MAX_CUTTER_BALLS, STANDARD_SCALLOP_MM};
use crate::declaration::Range;
use crate::error::SceneError;
use crate::model::{CutterShape, ManipulatorRung, Scene, ToolDescription, ToolFlexure, ToolTendon};
use crate::tool::FlexurePlace;

/// Tolerated overlap of flexures, mm: they can touch, and this is rounding.
const TOUCH_MM: f64 = 1e-6;
/// Least distance between the last two corners of a cutter, mm: a shorter one would be another shape.
const SHORTEST_MM: f64 = 0.1;
/// Largest twist of a tendon between neighbouring flexures, degrees: the model takes it as straight there.
const MOST_TWIST_DEG: f64 = 45.0;
/// Relative tolerance for rest curvatures to count as equal.
const SAME_CURVATURE: f64 = 0.01;

/// Checks a tool. `above` prefixes its keys: empty in a tool file.
pub(crate) fn tool(tool: &ToolDescription, above: &str, checker: &Checker) -> Result<(), SceneError> {
    let check = Check { tool, above, checker };
    check.tube()?;
    check.flexures()?;
    let places = tool.flexures();
    check.places(&places)?;
    for (index, place) in places.iter().enumerate() {
        check.stiffness(&places, index, place)?;
    }
    check.shaft(places[0].at_mm)?;
    check.burr(&places)?;
    check.drive_shaft(&places)?;
    check.outer_tube(&places)?;
    tool.tendon.iter().enumerate().try_for_each(|(index, tendon)| check.tendon(index, tendon, &places))
}

struct Check<'a> {
    tool: &'a ToolDescription,
    above: &'a str,
    checker: &'a Checker<'a>,
}

impl Check<'_> {
    fn range(&self, key: &str, value: f64, lowest: f64, highest: f64) -> Result<(), SceneError> {
        let allowed = Range { lowest, highest, or_zero: false };
        self.checker.range(&format!("{}{key}", self.above), value, allowed)
    }

    fn invalid(&self, key: &str, problem: impl Into<String>) -> SceneError {
        self.checker.invalid(&format!("{}{key}", self.above), problem)
    }

    fn tube(&self) -> Result<(), SceneError> {
        let tube = &self.tool.tube;
        // A wall must be at least a hundredth of a millimetre thick.
        self.range("tube.inner_diameter_mm", tube.inner_diameter_mm, 0.0, tube.outer_diameter_mm - 0.02)?;
        let cable_mm = tube.drive_cable_diameter_mm.unwrap_or(0.0);
        self.range("tube.drive_cable_diameter_mm", cable_mm, 0.0, tube.inner_diameter_mm)
    }

    fn flexures(&self) -> Result<(), SceneError> {
        for (index, flexure) in self.tool.flexure.iter().enumerate() {
            if flexure.count > 1 && flexure.pitch_mm.is_none() {
                let key = format!("flexure[{index}].pitch_mm");
                return Err(self.invalid(&key, format!("is missing; `count` is {}", flexure.count)));
            }
        }
        let number = self.tool.flexure.iter().map(|flexure| flexure.count).sum::<usize>();
        self.range("flexure (count)", number as f64, 1.0, MAX_JOINTS as f64)
    }

    /// Checks that the flexures lie in order from the flange and do not overlap.
    fn places(&self, places: &[FlexurePlace]) -> Result<(), SceneError> {
        for (index, pair) in places.windows(2).enumerate() {
            let half_mm = |place: usize| 0.5 * places[place].flexure.length_mm.unwrap_or(0.0);
            let lowest = pair[0].at_mm + (half_mm(index) + half_mm(index + 1)).max(0.01);
            if pair[1].at_mm < lowest - TOUCH_MM {
                let key = format!("flexure[{}].at_mm", pair[1].entry);
                let problem = format!(
                    "puts a flexure at {}; allowed: {lowest} or more, so that it does not overlap the one \
                     before",
                    pair[1].at_mm
                );
                return Err(self.invalid(&key, problem));
            }
        }
        let first = &places[0];
        let lowest = 0.5 * first.flexure.length_mm.unwrap_or(0.0);
        self.range("flexure[0].at_mm", first.at_mm, lowest, 1000.0)
    }

    fn stiffness(
        &self,
        places: &[FlexurePlace],
        index: usize,
        place: &FlexurePlace,
    ) -> Result<(), SceneError> {
        let (entry, flexure) = (place.entry, place.flexure);
        self.notch(ToolDescription::pitch_mm(places, index), entry, flexure)?;
        if flexure.stiffness_nm_per_deg.is_some() {
            return Ok(());
        }
        if self.tool.tube.youngs_modulus_gpa.is_none() {
            let problem = "is missing; set it, or `tube.youngs_modulus_gpa`, from which it is computed";
            return Err(self.invalid(&format!("flexure[{entry}].stiffness_nm_per_deg"), problem));
        }
        if ToolDescription::length_mm(places, index).is_none() {
            let problem = "is missing; a single flexure has no neighbours to compute it from";
            return Err(self.invalid(&format!("flexure[{entry}].length_mm"), problem));
        }
        Ok(())
    }

    /// Checks the notch against the range in which the notch formulas hold.
    fn notch(&self, pitch_mm: Option<f64>, entry: usize, flexure: &ToolFlexure) -> Result<(), SceneError> {
        let (width_mm, past_mm) = match (flexure.notch_width_mm, flexure.notch_past_axis_mm) {
            (None, None) => return Ok(()),
            (Some(width_mm), Some(past_mm)) => (width_mm, past_mm),
            (None, _) => return Err(self.invalid(&format!("flexure[{entry}].notch_width_mm"), "is missing")),
            (_, None) => {
                return Err(self.invalid(&format!("flexure[{entry}].notch_past_axis_mm"), "is missing"));
            }
        };
        let Some(pitch_mm) = pitch_mm else {
            let problem = "needs two or more flexures: a flexure is the material between two notches";
            return Err(self.invalid(&format!("flexure[{entry}].notch_width_mm"), problem));
        };
        self.range(&format!("flexure[{entry}].notch_width_mm"), width_mm, 0.05, 0.95 * pitch_mm)?;
        let tube = &self.tool.tube;
        let middle_mm = 0.25 * (tube.outer_diameter_mm + tube.inner_diameter_mm);
        // The ring left behind the notch's end is as high as two pitches less the notch.
        let most_mm = middle_mm - 0.5 * (2.0 * pitch_mm - width_mm);
        self.range(&format!("flexure[{entry}].notch_past_axis_mm"), past_mm, 0.5 * width_mm, most_mm)
    }

    fn shaft(&self, first_mm: f64) -> Result<(), SceneError> {
        let shaft = &self.tool.shaft;
        let to_mm = shaft.contact_to_mm.unwrap_or(first_mm);
        self.range("shaft.contact_to_mm", to_mm, 0.0, first_mm)?;
        self.range("shaft.contact_from_mm", shaft.contact_from_mm.unwrap_or(0.0), 0.0, to_mm)
    }

    /// The centre of the cutter's last ball lies ahead of the tube's end, which is half a pitch ahead of the
    /// last flexure.
    fn burr(&self, places: &[FlexurePlace]) -> Result<(), SceneError> {
        self.shape()?;
        let length_mm = ToolDescription::length_mm(places, places.len() - 1);
        let end_mm = 0.5 * length_mm.unwrap_or(0.0) + self.tool.burr.span_mm();
        let offset_mm = self.tool.burr.offset_mm;
        if offset_mm < end_mm - TOUCH_MM {
            let problem =
                format!("is {offset_mm}; allowed: {end_mm} to 500, so that the cutter lies outside the tube");
            return Err(self.invalid("burr.offset_mm", problem));
        }
        Ok(())
    }

    /// Checks the drive shaft: it needs a flexure length to bend over, a lumen, a cutter with mass, and a
    /// motor stronger than its friction.
    fn drive_shaft(&self, places: &[FlexurePlace]) -> Result<(), SceneError> {
        let Some(shaft) = &self.tool.drive_shaft else { return Ok(()) };
        if self.tool.tube.inner_diameter_mm == 0.0 {
            return Err(self.invalid("drive_shaft", "needs a lumen; `tube.inner_diameter_mm` is 0"));
        }
        let has_length = (0..places.len()).all(|index| ToolDescription::length_mm(places, index).is_some());
        if shaft.bending_stiffness_nm2 > 0.0 && !has_length {
            let problem = "is missing; the drive shaft bends over this length";
            return Err(self.invalid("flexure[0].length_mm", problem));
        }
        if shaft.torsional_stiffness_nm2.is_some() && self.tool.burr.mass_g == 0.0 {
            let problem = "is 0; expected more than 0, because the burr turns on an elastic shaft";
            return Err(self.invalid("burr.mass_g", problem));
        }
        match shaft.stall_torque_nmm {
            Some(stall_nmm) if shaft.friction_torque_nmm >= stall_nmm => {
                let problem = format!(
                    "is {}, expected less than `drive_shaft.stall_torque_nmm` ({stall_nmm}): the burr would \
                     never turn",
                    shaft.friction_torque_nmm
                );
                Err(self.invalid("drive_shaft.friction_torque_nmm", problem))
            }
            _ => Ok(()),
        }
    }

    /// Checks the outer tube: it covers a flexible part but not the burr, has a wall and room for the tube,
    /// and the tool has no tendons, which would slide with the tube.
    fn outer_tube(&self, places: &[FlexurePlace]) -> Result<(), SceneError> {
        let Some(outer) = &self.tool.outer_tube else { return Ok(()) };
        let burr_mm = places[places.len() - 1].at_mm + self.tool.burr.offset_mm;
        let back_mm = burr_mm - self.tool.burr.span_mm();
        self.range("outer_tube.end_mm", outer.end_mm, places[0].at_mm, back_mm)?;
        let (tube_mm, outer_mm) = (self.tool.tube.outer_diameter_mm, outer.outer_diameter_mm);
        self.range("outer_tube.outer_diameter_mm", outer_mm, tube_mm + 0.02, 30.0)?;
        self.range("outer_tube.inner_diameter_mm", outer.inner_diameter_mm, tube_mm, outer_mm - 0.02)?;
        if !self.tool.tendon.is_empty() {
            let problem =
                "and `outer_tube` are mutually exclusive: tendons in a sliding tube are not modelled";
            return Err(self.invalid("tendon", problem));
        }
        Ok(())
    }

    /// Checks that the shape has exactly its own keys, and that they give a body of distinct balls.
    fn shape(&self) -> Result<(), SceneError> {
        let burr = &self.tool.burr;
        let (is_cone, is_bit) = (burr.shape() == CutterShape::Cone, burr.shape() == CutterShape::Bit);
        let is_long = burr.shape() != CutterShape::Ball;
        for (key, is_given, has, of) in [
            ("burr.length_mm", burr.length_mm.is_some(), is_long, "shapes other than a ball"),
            ("burr.tip_diameter_mm", burr.tip_diameter_mm.is_some(), is_cone || is_bit, "a cone or a bit"),
            ("burr.point_deg", burr.point_deg.is_some(), is_bit, "a bit"),
        ] {
            match (is_given, has) {
                (true, false) => {
                    return Err(self.invalid(key, format!("applies only to {of}; `burr.shape` is different")));
                }
                (false, true) => {
                    return Err(self.invalid(key, format!("is missing; required for {of}")));
                }
                _ => {}
            }
        }
        if burr.rake_deg.is_some() && !is_bit {
            return Err(self.invalid("burr.rake_deg", "applies only to a bit; `burr.shape` is different"));
        }
        if burr.scallop_mm.is_some() && !is_long {
            return Err(self.invalid(
                "burr.scallop_mm",
                "applies only to shapes other than a ball; `burr.shape` is different",
            ));
        }
        let (Some(length_mm), true) = (burr.length_mm, is_long) else { return Ok(()) };
        let tip_mm = burr.tip_diameter_mm.unwrap_or(burr.diameter_mm);
        if is_cone || is_bit {
            // A smaller step would be a cylinder's.
            self.range("burr.tip_diameter_mm", tip_mm, 0.1, burr.diameter_mm - 0.05)?;
        }
        // The corners before the last one keep their place, so only the last piece can be too short; nested
        // balls are no shape.
        let before_mm = 1e3 * burr.corners().iter().rev().nth(1).map_or(0.0, |corner| corner.behind_m);
        let ends_mm = 0.5 * (tip_mm + burr.diameter_mm);
        let cone_mm = if is_cone { 0.5 * (burr.diameter_mm - tip_mm) } else { 0.0 };
        self.range("burr.length_mm", length_mm, ends_mm + before_mm + 1.1 * cone_mm + SHORTEST_MM, 60.0)?;
        let wanted = burr.balls_wanted();
        if wanted > MAX_CUTTER_BALLS {
            let problem = format!(
                "is {}, which takes {wanted} balls; allowed: {MAX_CUTTER_BALLS}. Use a larger scallop or a \
                 shorter cutter",
                burr.scallop_mm.unwrap_or(STANDARD_SCALLOP_MM)
            );
            return Err(self.invalid("burr.scallop_mm", problem));
        }
        Ok(())
    }

    fn tendon(&self, index: usize, tendon: &ToolTendon, places: &[FlexurePlace]) -> Result<(), SceneError> {
        let (from, count) = (tendon.from_flexure as f64, places.len() as f64);
        let apart_mm = places.windows(2).map(|pair| pair[1].at_mm - pair[0].at_mm);
        let longest_mm = apart_mm.fold(MOST_TWIST_DEG / 180.0, f64::max);
        self.range(&format!("tendon[{index}].from_flexure"), from, 1.0, count)?;
        let to = tendon.to_flexure.map_or(count, |to| to as f64);
        self.range(&format!("tendon[{index}].to_flexure"), to, from, count)?;
        let most = MOST_TWIST_DEG / longest_mm;
        self.range(
            &format!("tendon[{index}].twist_deg_per_mm"),
            tendon.twist_deg_per_mm.unwrap_or(0.0),
            -most,
            most,
        )
    }
}

/// Checks that a scene's other keys are compatible with the tool it describes.
pub(crate) fn beside(scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    let manipulator = &scene.manipulator;
    let is_modal = manipulator.model == Some(ManipulatorRung::Modal);
    if manipulator.modes.is_some() && !is_modal {
        let problem = "applies only to the modal model; set `manipulator.model` to modal, or omit `modes`";
        return Err(checker.invalid("manipulator.modes", problem));
    }
    let Some(described) = &manipulator.tool else { return Ok(()) };
    tool(described, "manipulator.tool.", checker)?;
    let notches = [
        ("manipulator.notch_width_mm", manipulator.notch_width_mm.is_some()),
        ("manipulator.notch_past_axis_mm", manipulator.notch_past_axis_mm.is_some()),
        ("tendon", !scene.tendon.is_empty()),
    ];
    if let Some((key, _)) = notches.iter().find(|(_, given)| *given) {
        let problem = "applies only to the standard tool; for another tool, set it in the tool's description";
        return Err(checker.invalid(key, problem));
    }
    if manipulator.burr_diameter_mm.is_some() && described.burr.shape() != CutterShape::Ball {
        let problem =
            "applies only to a ball burr; the tool's cutter has its dimensions in the tool's description";
        return Err(checker.invalid("manipulator.burr_diameter_mm", problem));
    }
    if manipulator.model == Some(ManipulatorRung::ConstantCurvature) {
        one_arc(described, checker)?;
    }
    if is_modal {
        smooth_moments(described, checker)?;
    }
    Ok(())
}

/// Refuses tools that the modal model cannot represent: their moments jump where a tendon or an outer tube
/// ends.
fn smooth_moments(tool: &ToolDescription, checker: &Checker) -> Result<(), SceneError> {
    bends_in_parts(tool).map_or(Ok(()), |why| {
        let problem =
            format!("is modal, which needs smooth bending moments; {why}; expected planar, spatial or full");
        Err(checker.invalid("manipulator.model", problem))
    })
}

/// Returns why the tool does not bend along its whole length, if so.
fn bends_in_parts(tool: &ToolDescription) -> Option<String> {
    if tool.outer_tube.is_some() {
        return Some(format!("`{}` slides out of a tube that holds it straight", tool.name));
    }
    let flexures = tool.flexures().len();
    let in_part =
        |tendon: &ToolTendon| tendon.from_flexure > 1 || tendon.to_flexure.is_some_and(|to| to < flexures);
    let index = tool.tendon.iter().position(in_part)?;
    Some(format!("tendon {} of `{}` bends only part of the tool", index + 1, tool.name))
}

/// Checks a tool for the cheapest model, a single arc: its rest shape and its tendons must bend it uniformly.
fn one_arc(tool: &ToolDescription, checker: &Checker) -> Result<(), SceneError> {
    let refused = |why: String| {
        let problem = format!("is constant_curvature, a single arc; {why}; expected planar, spatial or full");
        Err(checker.invalid("manipulator.model", problem))
    };
    if let Some(why) = bends_in_parts(tool) {
        return refused(why);
    }
    let places = tool.flexures();
    let curvature = |index: usize| {
        let length_mm = ToolDescription::pitch_mm(&places, index).unwrap_or(1.0);
        places[index].flexure.rest_deg / length_mm
    };
    let all: Vec<f64> = (0..places.len()).map(curvature).collect();
    let most = all.iter().fold(0.0, |most: f64, own| most.max(own.abs()));
    if all.iter().any(|own| (own - all[0]).abs() > SAME_CURVATURE * most) {
        return refused(format!("`{}` is not pre-curved to one radius", tool.name));
    }
    Ok(())
}
