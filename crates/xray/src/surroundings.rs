//! What frames show beside bone and tool: the arm, the scene's X-ray objects, and its rigid bodies.

use std::sync::Arc;

use messages::State;
use scene::closed_mesh::ClosedMesh;
use scene::{Body, DrrObject, ObjectFrame, Scene, XRayMaterial};

use crate::arm_model::ArmModel;
use crate::attenuation::Material;
use crate::error::DrrError;
use crate::placement::Placement;
use crate::solids::PlacedSolids;
use crate::tool::{PlacedObjects, Tool, ToolPart};
use crate::vector::{Vec3, norm, scale};

/// The arm and the objects of a scene.
#[derive(Debug, Clone, Default)]
pub struct Surroundings {
    arm: Option<Arc<ArmModel>>,
    objects: Vec<Object>,
}

#[derive(Debug, Clone)]
struct Object {
    /// Names of its balls as markers; none of a body.
    markers: Vec<String>,
    material: Material,
    shape: Shape,
    carrier: Carrier,
    t_carrier_object: Placement,
    /// Largest distance of its points from its origin, m.
    reach_m: f64,
}

/// Largest coordinate of an object in a frame, m: that of a tool's part. No detector is farther away.
const FARTHEST_M: f64 = 100.0;

/// What an object moves with.
#[derive(Debug, Clone, Copy)]
enum Carrier {
    World,
    Flange,
    ToolBase,
    /// A rigid body, by its number.
    Body(usize),
}

/// A shape in the object's frame, m.
#[derive(Debug, Clone)]
enum Shape {
    Balls {
        radius_m: f64,
        centres_m: Vec<Vec3>,
    },
    Cylinder {
        ends_m: [Vec3; 2],
        radii_m: [f64; 2],
    },
    /// Along z.
    Capsule {
        half_height_m: f64,
        radius_m: f64,
    },
    Cuboid {
        half_m: [f64; 3],
    },
    Mesh(Arc<[ClosedMesh]>),
}

impl Surroundings {
    /// Reads the objects and bodies of a scene that frames show.
    ///
    /// # Errors
    /// The surface of a mesh is missing or malformed.
    pub fn new(scene: &Scene, arm: Option<Arc<ArmModel>>) -> Result<Self, DrrError> {
        let objects = scene.drr.iter().flat_map(|drr| &drr.object).map(|object| Object::new(object, scene));
        let bodies = scene.body.iter().enumerate().filter_map(|(number, body)| Object::of_body(number, body));
        let objects = objects.chain(bodies.map(Ok)).collect::<Result<Vec<Object>, DrrError>>()?;
        Ok(Self { arm, objects })
    }

    /// Places arm and objects beside a tool, as in a state.
    pub fn put_around(&self, state: &State, tool: &mut Tool) {
        tool.arm = self.arm.as_ref().map(|arm| arm.placed(state));
        self.objects.iter().for_each(|object| object.put_in(state, &mut tool.objects));
    }

    /// Name and world position of the centre of each marker ball, in the scene's order.
    pub fn markers_m(&self, state: &State) -> Vec<(String, [f64; 3])> {
        let of_object = |object: &Object| {
            let Shape::Balls { centres_m, .. } = &object.shape else { return Vec::new() };
            let place = object.placed(state);
            let ball = |(name, centre_m): (&String, &Vec3)| (name.clone(), place.point(*centre_m));
            object.markers.iter().zip(centres_m).map(ball).collect()
        };
        self.objects.iter().flat_map(of_object).collect()
    }
}

impl Object {
    fn new(object: &DrrObject, scene: &Scene) -> Result<Self, DrrError> {
        let carrier = match object.attached {
            ObjectFrame::World | ObjectFrame::Anatomy => Carrier::World,
            ObjectFrame::Flange => Carrier::Flange,
            ObjectFrame::Tool => Carrier::ToolBase,
        };
        let own = Placement::of_rotation_vector(metres(object.position_mm), object.rotation_vector_deg);
        let t_carrier_object =
            if object.attached == ObjectFrame::Anatomy { bone(scene).then(&own) } else { own };
        let shape = if let Some(balls) = &object.balls {
            let centres_m = balls.centres_mm.iter().map(|mm| metres(*mm)).collect();
            Shape::Balls { radius_m: balls.radius_mm * 1e-3, centres_m }
        } else if let Some(cylinder) = &object.cylinder {
            let ends_m = [cylinder.start_mm, cylinder.end_mm].map(metres);
            let radii_m = [cylinder.radius_mm, cylinder.inner_radius_mm].map(|mm| mm * 1e-3);
            Shape::Cylinder { ends_m, radii_m }
        } else if let Some(cuboid) = &object.cuboid {
            Shape::Cuboid { half_m: metres(cuboid.half_extents_mm) }
        } else {
            let surface = object.mesh.as_ref().and_then(|mesh| mesh.surface.as_ref());
            let mesh = surface.map_or_else(|| Err("has not been read".to_owned()), |surface| surface.mesh());
            let refuse = |problem| DrrError::Object { name: object.name.clone(), problem };
            Shape::Mesh(Arc::from([mesh.map_err(refuse)?.scaled([1e-3; 3])]))
        };
        let (markers, material) = (object.marker_names(), material_of(object.material));
        let reach_m = shape.reach_m();
        Ok(Self { markers, material, shape, carrier, t_carrier_object, reach_m })
    }

    /// A rigid body; `None` if frames do not show it.
    fn of_body(number: usize, body: &Body) -> Option<Self> {
        let material = material_of(body.material?);
        let shape = match (&body.cuboid, &body.ball, &body.capsule) {
            (Some(cuboid), ..) => Shape::Cuboid { half_m: metres(cuboid.half_extents_mm) },
            (_, Some(ball), _) => Shape::Balls { radius_m: ball.radius_mm * 1e-3, centres_m: vec![[0.0; 3]] },
            (.., Some(capsule)) => {
                let [half_height_m, radius_m] =
                    [capsule.half_height_mm, capsule.radius_mm].map(|mm| mm * 1e-3);
                Shape::Capsule { half_height_m, radius_m }
            }
            _ => return None,
        };
        let (markers, carrier, reach_m) = (Vec::new(), Carrier::Body(number), shape.reach_m());
        Some(Self { markers, material, shape, carrier, t_carrier_object: Placement::IDENTITY, reach_m })
    }

    /// World placement in a state.
    fn placed(&self, state: &State) -> Placement {
        let t_world_carrier = match self.carrier {
            Carrier::World => return self.t_carrier_object,
            Carrier::Flange => &state.t_world_flange,
            Carrier::ToolBase => &state.t_world_base,
            Carrier::Body(number) => &state.t_world_body[number],
        };
        Placement::of_pose(t_world_carrier).then(&self.t_carrier_object)
    }

    /// Puts the object among those of a frame, unless it is too far away to be seen, as a body that falls.
    fn put_in(&self, state: &State, objects: &mut PlacedObjects) {
        let (place, material) = (self.placed(state), self.material);
        if place.point([0.0; 3]).iter().any(|x| x.abs() + self.reach_m > FARTHEST_M) {
            return;
        }
        let parts = &mut objects.parts;
        match &self.shape {
            Shape::Balls { radius_m, centres_m } => parts.extend(centres_m.iter().map(|centre_m| {
                ToolPart::Sphere { centre_m: place.point(*centre_m), radius_m: *radius_m, material }
            })),
            Shape::Cylinder { ends_m: [start_m, end_m], radii_m } => {
                parts.push(ToolPart::tube(place.point(*start_m), place.point(*end_m), *radii_m, material));
            }
            Shape::Capsule { half_height_m, radius_m } => {
                let end_m = |side: f64| place.point([0.0, 0.0, side * half_height_m]);
                parts.push(ToolPart::tube(end_m(-1.0), end_m(1.0), [*radius_m, 0.0], material));
                let half_ball = |side: f64| ToolPart::SphereZone {
                    centre_m: end_m(side),
                    radius_m: *radius_m,
                    axis: place.direction([0.0, 0.0, side]),
                    along_m: [0.0, *radius_m],
                    material,
                };
                parts.extend([-1.0, 1.0].map(half_ball));
            }
            Shape::Cuboid { half_m } => {
                let axes = Placement::IDENTITY.axes().map(|axis| place.direction(axis));
                parts.push(ToolPart::Cuboid {
                    centre_m: place.point([0.0; 3]),
                    axes,
                    half_m: *half_m,
                    material,
                });
            }
            Shape::Mesh(solids) => objects.solids.push(PlacedSolids {
                solids: Arc::clone(solids),
                places: vec![place],
                material,
                density_g_per_cm3: material.density_g_per_cm3(),
            }),
        }
    }
}

impl Shape {
    /// Returns the largest distance of its points from the origin, or more, m.
    fn reach_m(&self) -> f64 {
        let farthest = |points_m: &[Vec3]| points_m.iter().copied().map(norm).fold(0.0, f64::max);
        match self {
            Shape::Balls { radius_m, centres_m } => farthest(centres_m) + radius_m,
            Shape::Cylinder { ends_m, radii_m } => farthest(ends_m) + radii_m[0],
            Shape::Capsule { half_height_m, radius_m } => half_height_m + radius_m,
            Shape::Cuboid { half_m } => norm(*half_m),
            Shape::Mesh(solids) => solids.iter().map(|solid| farthest(solid.corners())).fold(0.0, f64::max),
        }
    }
}

/// Placement of the true bone: where points of the plan are.
fn bone(scene: &Scene) -> Placement {
    let axes = Placement::IDENTITY.axes().map(|axis| scene.turned_with_bone(axis));
    Placement::of_axes(axes, metres(scene.in_bone_mm([0.0; 3])))
}

fn metres(mm: [f64; 3]) -> Vec3 {
    scale(mm, 1e-3)
}

fn material_of(material: XRayMaterial) -> Material {
    match material {
        XRayMaterial::Steel => Material::Steel316L,
        XRayMaterial::Titanium => Material::Titanium,
        XRayMaterial::CobaltChromium => Material::CobaltChromium,
        XRayMaterial::Tantalum => Material::Tantalum,
        XRayMaterial::Lead => Material::Lead,
        XRayMaterial::Aluminium => Material::Aluminium,
        XRayMaterial::Pmma => Material::Pmma,
    }
}
