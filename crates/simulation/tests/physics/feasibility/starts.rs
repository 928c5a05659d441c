//! Start of the tool: bone, holes, bodies.

use crate::feasibility::scene_text::{
    Case, HOLE, case, changed, changed_in, driven_by, start, start_driven_by,
};

pub fn cases() -> Vec<Case> {
    [places(), bone(), holes(), bodies()].into_iter().flatten().collect()
}

fn places() -> Vec<Case> {
    vec![
        case(
            "the entry in metres",
            start("[0.1, 0.0, -0.015]"),
            &[
                "impossible: `tool.burr_start_mm` is [0.1, 0, -0.015], 79.7 mm from the nearest bone, \
                 but 1000 times that is inside the volume; expected millimetres, not metres",
                "impossible: `tool.burr_start_mm` puts the burr 79.7 mm from the nearest bone; \
                 allowed: at most 55.4: `controller.curved_drilling.insertion_mm` plus the tool's \
                 flexible length",
            ],
        ),
        case(
            "the entry in metres, outside the volume a thousand times as large",
            start("[0.0799, 0.0, -0.015]"),
            &["impossible: `tool.burr_start_mm` puts the burr 79.7 mm from the nearest bone; allowed: \
               at most 55.4: `controller.curved_drilling.insertion_mm` plus the tool's flexible \
               length"],
        ),
        case(
            "an entry just under a millimetre, bone at a metre",
            start("[0.999, 0.0, -0.015]"),
            &[
                "impossible: `tool.burr_start_mm` is [0.999, 0, -0.015], 978.8 mm from the nearest \
                 bone, but 1000 times that is inside the volume; expected millimetres, not metres",
                "impossible: `tool.burr_start_mm` puts the burr 978.8 mm from the nearest bone; \
                 allowed: at most 55.4: `controller.curved_drilling.insertion_mm` plus the tool's \
                 flexible length",
            ],
        )
        .with_bone_at(1000.0),
        case(
            "an entry at a millimetre, bone at a metre",
            start("[1.0, 0.0, -0.015]"),
            &["impossible: `tool.burr_start_mm` puts the burr 978.8 mm from the nearest bone; allowed: \
               at most 55.4: `controller.curved_drilling.insertion_mm` plus the tool's flexible \
               length"],
        )
        .with_bone_at(1000.0),
        case(
            "an entry near the world's origin in a hole there",
            start("[0.01, 0.0, -0.005]").replace(
                "[tool]",
                "[[predrill]]\nfrom_mm = [0.0, 0.0, -60.0]\nto_mm = [0.0, 0.0, 0.0]\n\
                 diameter_mm = 7.0\n[tool]",
            ),
            &[],
        )
        .with_bone_at(0.0),
        // The burr is 9.94 mm and 10.04 mm from the block's side.
        case("an entry near the world's origin, 10 mm from bone", start("[0.011, 0.0, 0.0]"), &[])
            .with_bone_at(30.2),
        case(
            "an entry near the world's origin, over 10 mm from bone",
            start("[0.011, 0.0, 0.0]"),
            &["impossible: `tool.burr_start_mm` is [0.011, 0, 0], 10.0 mm from the nearest bone, but \
               1000 times that is inside the volume; expected millimetres, not metres"],
        )
        .with_bone_at(30.3),
        case(
            "the tool a metre beside the bone",
            start("[1117.0, 0.0, -15.0]"),
            &["impossible: `tool.burr_start_mm` puts the burr 996.8 mm from the nearest bone; allowed: \
               at most 55.4: `controller.curved_drilling.insertion_mm` plus the tool's flexible \
               length"],
        ),
        case("bone just within the feed and the tool's flexible length", start("[100.0, 0.0, -85.6]"), &[]),
        case(
            "bone just beyond the feed and the tool's flexible length",
            start("[100.0, 0.0, -85.8]"),
            &["impossible: `tool.burr_start_mm` puts the burr 55.6 mm from the nearest bone; allowed: \
               at most 55.4: `controller.curved_drilling.insertion_mm` plus the tool's flexible \
               length"],
        ),
        case(
            "a straight feed that ends before the bone",
            start_driven_by(
                "[100.0, 0.0, -80.0]",
                "skiving = { feed_mm_per_s = 8.0, depth_mm = 10.0, burr_speed_rpm = 8000.0 }",
            ),
            &["impossible: `tool.burr_start_mm` puts the burr 49.8 mm from the nearest bone; allowed: \
               at most 45.4: `controller.skiving.depth_mm` plus the tool's flexible length"],
        ),
        case(
            "a metre beside the bone, driven by a program",
            driven_by("external = true").replace("burr_start_mm = [100.0,", "burr_start_mm = [1117.0,"),
            &["unlikely: `tool.burr_start_mm` puts the burr 996.8 mm from the nearest bone"],
        ),
        case(
            "100 mm from the bone, driven by a program",
            start_driven_by("[100.0, 0.0, -130.24]", "external = true"),
            &[],
        ),
        case(
            "over 100 mm from the bone, driven by a program",
            start_driven_by("[100.0, 0.0, -130.35]", "external = true"),
            &["unlikely: `tool.burr_start_mm` puts the burr 100.1 mm from the nearest bone"],
        ),
        case(
            "a metre beside the bone, and only held",
            start_driven_by("[1117.0, 0.0, -15.0]", "hold = { tension_n = 1.0 }"),
            &[],
        ),
    ]
}

fn bone() -> Vec<Case> {
    vec![
        case(
            "no pilot hole",
            changed(HOLE, ""),
            &[
                "unlikely: `tool.burr_start_mm` puts the burr 12.0 mm inside bone; start in front of \
                 it, or in a `[[predrill]]` hole",
                "unlikely: `tool.burr_start_mm` puts the shaft up to 8.6 mm inside bone; add a \
                 `[[predrill]]` hole along it",
            ],
        ),
        // The flange is 60 mm in front of the tool's base, in the block, and advances 20 mm farther.
        case(
            "a wrist around the tool",
            changed("[arm]\n", "[arm]\ntool_position_mm = [0.0, 0.0, -70.0]\n"),
            &[
                "unlikely: `arm.tool_position_mm` is [0, 0, -70]: the arm's holder starts 10 mm inside \
                 bone (the arm does not collide); move the tool farther from the flange, e.g. [0.0, \
                 0.0, 200.0]",
                "unlikely: `arm.tool_position_mm` is [0, 0, -70]: the arm's wrist 3 ends 30 mm inside \
                 bone (the arm does not collide); move the tool farther from the flange, e.g. [0.0, \
                 0.0, 200.0]",
            ],
        ),
        case(
            "a flange as far in front of the bone as the tool goes in",
            changed("[arm]\n", "[arm]\ntool_position_mm = [0.0, 0.0, -39.0]\n"),
            &[],
        ),
        case("the burr's centre on the bone's face", start("[100.0, 0.0, -27.0]"), &[]),
        case("the burr's centre in bone by less than is printed", start("[100.0, 0.0, -26.96]"), &[]),
        case(
            "the burr's centre in bone by what is printed",
            start("[100.0, 0.0, -26.94]"),
            &["unlikely: `tool.burr_start_mm` puts the burr 0.1 mm inside bone; start in front of it, \
               or in a `[[predrill]]` hole"],
        ),
        case(
            "the burr's centre a tenth of a millimetre in bone",
            start("[100.0, 0.0, -26.9]"),
            &["unlikely: `tool.burr_start_mm` puts the burr 0.1 mm inside bone; start in front of it, \
               or in a `[[predrill]]` hole"],
        ),
        // The tool passes through the block from above and protrudes from it.
        case(
            "a shaft in bone, the burr in front of it",
            changed_in(
                &start("[100.0, 0.0, -30.0]"),
                "direction = [0.0, 0.0, 1.0]",
                "direction = [0.0, 0.0, -1.0]",
            ),
            &[
                "unlikely: `tool.burr_start_mm` puts the shaft up to 17.0 mm inside bone; add a \
                 `[[predrill]]` hole along it",
                // The flange ends at 71.47 - 30 - 20 = 21.47 mm, the upper face is at 27 mm.
                "unlikely: `arm.tool_position_mm` is [0, 0, 0]: the arm's wrist 3 ends 5 mm inside \
                 bone (the arm does not collide); move the tool farther from the flange, e.g. [0.0, \
                 0.0, 200.0]",
            ],
        ),
        case(
            "a threshold of the volume's largest value",
            changed("phantom = \"block\"\n", "phantom = \"block\"\nbone_threshold_hu = 300\n"),
            &[],
        ),
        case(
            "a threshold just above the volume's largest value",
            changed("phantom = \"block\"\n", "phantom = \"block\"\nbone_threshold_hu = 301\n"),
            &["impossible: `volume.bone_threshold_hu` is 301; allowed: -1000 to 300 (the volume's \
               largest value): no bone to drill"],
        ),
        case(
            "the largest threshold that a scene may have",
            changed("phantom = \"block\"\n", "phantom = \"block\"\nbone_threshold_hu = 3000\n"),
            &["impossible: `volume.bone_threshold_hu` is 3000; allowed: -1000 to 300 (the volume's \
               largest value): no bone to drill"],
        ),
        case(
            "a threshold without bone, and no controller drills",
            changed_in(
                &driven_by("hold = { tension_n = 1.0 }"),
                "phantom = \"block\"\n",
                "phantom = \"block\"\nbone_threshold_hu = 301\n",
            ),
            &["unlikely: `volume.bone_threshold_hu` is 301, but the volume's largest value is 300 HU: \
               no bone to drill"],
        ),
    ]
}

fn holes() -> Vec<Case> {
    let hole = |diameter: &str| changed("diameter_mm = 7.0", &format!("diameter_mm = {diameter}"));
    let burr = |diameter: &str| {
        changed("[manipulator]\n", &format!("[manipulator]\nburr_diameter_mm = {diameter}\n"))
    };
    vec![
        case(
            "a hole thinner than the tool",
            hole("5.0"),
            &["impossible: `predrill.diameter_mm` is 5; allowed: 6 to 50: the tool, 6.0 mm thick, \
               starts in this hole"],
        ),
        case(
            "a hole just thinner than the tool",
            hole("5.99"),
            &["impossible: `predrill.diameter_mm` is 5.99; allowed: 6 to 50: the tool, 6.0 mm thick, \
               starts in this hole"],
        ),
        case(
            "a hole as thick as the tool",
            hole("6.0"),
            &["unlikely: `predrill.diameter_mm` is 6: the burr, 6.5 mm in diameter, starts in this \
               hole and touches its wall"],
        ),
        case(
            "a hole just thinner than the burr",
            hole("6.49"),
            &["unlikely: `predrill.diameter_mm` is 6.49: the burr, 6.5 mm in diameter, starts in this \
               hole and touches its wall"],
        ),
        case("a hole as thick as the burr", hole("6.5"), &[]),
        case(
            "a thin hole elsewhere",
            changed(
                HOLE,
                &format!(
                    "{HOLE}[[predrill]]\nfrom_mm = [110.0, 0.0, -60.0]\nto_mm = [110.0, 0.0, -15.0]\n\
                     diameter_mm = 2.0\n"
                ),
            ),
            &[],
        ),
        case(
            "a burr thinner than the tool",
            burr("5.0"),
            &["unlikely: `manipulator.burr_diameter_mm` is 5: the shaft, 6.0 mm thick, cannot follow a \
               burr this thin"],
        ),
        case(
            "a burr just thinner than the tool",
            burr("5.99"),
            &["unlikely: `manipulator.burr_diameter_mm` is 5.99: the shaft, 6.0 mm thick, cannot \
               follow a burr this thin"],
        ),
        case("a burr as thick as the tool", burr("6.0"), &[]),
        case(
            "the thinnest burr that a scene may have",
            burr("1.0"),
            &["unlikely: `manipulator.burr_diameter_mm` is 1: the shaft, 6.0 mm thick, cannot follow a \
               burr this thin"],
        ),
        case(
            "the thickest burr that a scene may have, in a thinner hole",
            burr("20.0"),
            &["unlikely: `predrill.diameter_mm` is 7: the burr, 20.0 mm in diameter, starts in this \
               hole and touches its wall"],
        ),
    ]
}

fn bodies() -> Vec<Case> {
    let clamp =
        |x: &str| changed("position_mm = [130.0, 0.0, -60.0]", &format!("position_mm = [{x}, 0.0, -60.0]"));
    let second = "[[body]]\nname = \"retractor\"\nball = { radius_mm = 5.0 }\nmotion = \"fixed\"\n\
                  position_mm = [104.0, 0.0, -40.0]\n[[controller]]";
    vec![
        case(
            "a body inside the tool",
            clamp("104.0"),
            &["impossible: `body.position_mm` puts `clamp` 1.00 mm into the tool; allowed: at most 0.1"],
        ),
        case("a body that overlaps the tool by less than the bound", clamp("104.91"), &[]),
        case(
            "a body that overlaps the tool by more than the bound",
            clamp("104.89"),
            &["impossible: `body.position_mm` puts `clamp` 0.11 mm into the tool; allowed: at most 0.1"],
        ),
        case(
            "of two bodies inside the tool, the deeper one",
            clamp("104.0").replace("[[controller]]", second),
            &["impossible: `body.position_mm` puts `retractor` 3.97 mm into the tool; allowed: at most 0.1"],
        ),
    ]
}
