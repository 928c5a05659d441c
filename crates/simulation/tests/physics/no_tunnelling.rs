//! A thin sheet stops a fast tool, and a tool that starts inside bone stays finite.

#![allow(clippy::unwrap_used, reason = "a test that cannot build its tool has failed")]

use nalgebra::{Isometry3, Vector3};
use simulation::bone::{BoneField, BoneParameters, ContactBuffer, GridGeometry};
use simulation::contact_plane::ContactPlane;
use simulation::manipulator::{
    BaseMotion, Manipulator, ManipulatorModel, ManipulatorParameters, StepInput, TendonCommand, Wrench,
};

const DT_S: f64 = 1e-3;

fn tool() -> Manipulator {
    let p = ManipulatorParameters { damping_ratio: 1.0, ..ManipulatorParameters::jhu_27() };
    Manipulator::new(p, &BaseMotion::at_rest(Isometry3::identity())).unwrap()
}

fn pull(tension_n: f64, base: BaseMotion, contacts: &[ContactPlane]) -> StepInput<'_> {
    let tendon = TendonCommand::Force([tension_n, 0.0]);
    StepInput { base, tendon, tip_wrench: Wrench::zero(), contacts }
}

/// A burr at 1 m/s meets a sheet one voxel thick: it is stopped at any phase of the steps.
#[test]
fn nothing_tunnels_at_a_metre_a_second() {
    let dims = [40, 40, 24];
    let geometry = GridGeometry::axis_aligned(dims, [0.5e-3; 3], Vector3::new(-9.75e-3, -9.75e-3, 70e-3));
    let hu: Vec<i16> =
        (0..geometry.voxel_count()).map(|i| if i / 1600 == 12 { 1000 } else { -1000 }).collect();
    let field = BoneField::new(geometry, &hu, BoneParameters::default()).unwrap();
    for phase in 0..8 {
        let mut m = tool();
        let mut buffer = ContactBuffer::with_capacity(128);
        let (mut z, mut most) = (-4e-3 - 0.125e-3 * f64::from(phase), f64::NEG_INFINITY);
        // The base stops where the straight tool would be 0.3 mm inside the sheet.
        let sheet = 70e-3 + 12.0 * 0.5e-3 - 0.25e-3;
        let front =
            |m: &Manipulator| m.t_world_tip().translation.vector.z + m.parameters().cutter.front_radius_m();
        let stop = sheet + 0.3e-3 - front(&m);
        let place = |z: f64| {
            let mut base = BaseMotion::at_rest(Isometry3::translation(0.0, 0.0, z));
            base.linear_velocity_m_per_s.z = if z < stop { 1.0 } else { 0.0 };
            base
        };
        m.place_base(&place(z)).unwrap();
        for _ in 0..40 {
            z = (z + 1.0 * DT_S).min(stop);
            buffer.clear();
            for (index, sphere) in m.proxy_spheres().iter().enumerate() {
                let margin = 1e-4 + sphere.velocity_m_per_s.norm() * DT_S;
                field.voxels().contact_planes(index, &sphere.centre_m, sphere.radius_m, margin, &mut buffer);
            }
            m.step(DT_S, &pull(0.0, place(z), buffer.planes())).unwrap();
            most = most.max(front(&m));
        }
        println!("phase {phase}: front {:.3} mm beyond the sheet's surface at most", (most - sheet) * 1e3);
        // As imposed by the base, and short of the sheet's other side at 0.5 mm.
        assert!(most - sheet < 0.35e-3, "phase {phase}");
        assert!(m.last_report().burr_normal_force_n.z < -1.0, "phase {phase}: it rests on the sheet");
    }
}

/// A whole tool that starts inside bone, in a tunnel narrower than itself, is pushed out or held, and every
/// number stays finite.
#[test]
fn a_tool_that_starts_inside_bone_stays_finite() {
    let dims = [48, 48, 240];
    let geometry = GridGeometry::axis_aligned(dims, [0.5e-3; 3], Vector3::new(-11.75e-3, -11.75e-3, -20e-3));
    let hu = vec![400; geometry.voxel_count()];
    for (bore_m, at_least) in [(0.0, 10), (2.0e-3, 27), (2.9e-3, 27)] {
        let mut field = BoneField::new(geometry, &hu, BoneParameters::default()).unwrap();
        if bore_m > 0.0 {
            let (from, to) = (Vector3::new(0.0, 0.0, -0.1), Vector3::new(0.0, 0.0, 0.08));
            field.predrill_capsule(&from, &to, bore_m);
        }
        let mut m = tool();
        let mut buffer = ContactBuffer::with_capacity(160);
        let rest = *m.base();
        let (mut fastest, mut active) = (0.0f64, 0);
        for _ in 0..300 {
            buffer.clear();
            for (index, sphere) in m.proxy_spheres().iter().enumerate() {
                field.voxels().contact_planes(index, &sphere.centre_m, sphere.radius_m, 1e-4, &mut buffer);
            }
            let report = m.step(DT_S, &pull(10.0, rest, buffer.planes())).unwrap();
            active = active.max(report.active_contact_count);
            fastest = m.proxy_spheres().iter().map(|s| s.velocity_m_per_s.norm()).fold(fastest, f64::max);
        }
        println!(
            "bore {:.1} mm: {active} contacts pressed at once, fastest sphere {fastest:.3} m/s",
            bore_m * 1e3
        );
        assert!(fastest.is_finite() && fastest < 3.0 && active >= at_least, "{active}");
    }
}
