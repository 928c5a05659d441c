//! Warnings about a volume that is valid but probably a mistake. Nothing is refused; each warning says what
//! to do.

use ipc_types::scene::Scene;
use voxel_grid::Volume;

/// Detects a volume of two values, typical of a mask.
pub fn of_a_mask(volume: &Volume) -> Option<String> {
    let first = volume.hu.first().copied()?;
    let other = volume.hu.iter().copied().find(|value| *value != first)?;
    let two = volume.hu.iter().all(|value| *value == first || *value == other);
    let (low, high) = (first.min(other), first.max(other));
    (two && low == 0 && high <= 255).then(|| {
        format!(
            "warning: every voxel is 0 or {high}: this looks like a mask, but is read as Hounsfield units; \
             to fill a mask, set \
             `volume.mask = true` in the scene"
        )
    })
}

/// Returns the hint for a point outside the volume that would be inside with x and y negated; empty for any
/// other.
pub fn ras_hint(volume: &Volume, place_mm: [f64; 3]) -> String {
    match is_likely_ras(volume, place_mm) {
        true => {
            let [x, y, z] = mirrored(place_mm);
            format!("; [{x:.1}, {y:.1}, {z:.1}] lies inside: for a point in RAS, negate x and y")
        }
        false => String::new(),
    }
}

/// RAS is LPS rotated by half a turn about z.
fn mirrored([x, y, z]: [f64; 3]) -> [f64; 3] {
    [-x, -y, z]
}

fn is_likely_ras(volume: &Volume, place_mm: [f64; 3]) -> bool {
    let is_inside = |place_mm: [f64; 3]| volume.holds(place_mm.map(|x| x * 1e-3));
    !is_inside(place_mm) && is_inside(mirrored(place_mm))
}

/// Finds points of the scene outside the volume that would be inside with x and y negated (RAS).
pub fn of_places(volume: &Volume, scene: &Scene) -> Vec<String> {
    let isocentre = scene.drr.as_ref().filter(|drr| drr.carm.is_none()).map(|drr| drr.isocentre_mm);
    let target =
        scene.controller.iter().find_map(|controller| controller.curved_drilling.as_ref()?.target_mm);
    let places = [
        ("tool.burr_start_mm", Some(scene.tool.burr_start_mm)),
        ("drr.isocentre_mm", isocentre),
        ("controller.curved_drilling.target_mm", target),
    ];
    places
        .into_iter()
        .filter_map(|(key, place)| Some((key, place?)))
        .filter(|(_, place)| is_likely_ras(volume, *place))
        .map(|(key, [x, y, z])| {
            format!(
                "warning: `{key}` = [{x}, {y}, {z}] lies outside the volume, but [{}, {}, {z}] lies inside: \
                 scenes use LPS; for a point in \
                 RAS, negate x and y",
                -x, -y
            )
        })
        .collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;
    use voxel_grid::VoxelGrid;

    fn volume(hu: [i16; 8]) -> Volume {
        let grid = VoxelGrid::axis_aligned([2, 2, 2], [0.01; 3], [0.04, 0.04, 0.0]).unwrap();
        Volume { grid, hu: hu.to_vec() }
    }

    fn scene(burr_start_mm: &str) -> Scene {
        let text = format!(
            "name = \"s\"\n[run]\nmode = \"lockstep\"\nduration_s = 0.1\n[volume]\nphantom \
             = \"block\"\n[tool]\nburr_start_mm = {burr_start_mm}\n\
             direction = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n"
        );
        Scene::parse(&text, std::path::Path::new("s.toml")).unwrap()
    }

    #[test]
    fn a_mask_that_is_not_called_one_is_named() {
        let said = |hu| of_a_mask(&volume(hu)).unwrap_or_default();
        assert!(said([0, 1, 1, 0, 0, 0, 1, 0]).contains("every voxel is 0 or 1: this looks like a mask"));
        assert!(said([255, 0, 0, 0, 0, 0, 0, 0]).contains("0 or 255"));
        assert_eq!(said([0, 0, 0, 0, 1000, 0, 0, 0]), "");
        assert_eq!(said([-1000, 1, 1, 0, 0, 0, 0, 0]), "");
        assert_eq!(said([0; 8]), "");
    }

    #[test]
    fn a_start_with_the_signs_of_ras_is_named() {
        let ct = volume([0; 8]);
        let said = |start: &str| of_places(&ct, &scene(start)).join("");
        assert!(said("[-45.0, -45.0, 5.0]").contains(
            "`tool.burr_start_mm` = [-45, -45, 5] lies outside the volume, but [45, 45, 5] lies inside"
        ));
        assert_eq!(said("[45.0, 45.0, 5.0]"), "");
        assert_eq!(said("[-45.0, 45.0, 5.0]"), "");
    }
}
