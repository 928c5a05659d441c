use nalgebra::*; use physics_proc::manipulator::*; use physics_proc::rigid::*;
fn main(){
    let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), ::core::f64::consts::FRAC_PI_2);
    let p = ManipulatorParameters { damping_ratio: 1.0, ..ManipulatorParameters::jhu_27() };
    let mut m = Manipulator::new(p, &BaseMotion::at_rest(Isometry3::from_parts(Translation3::identity(), turn))).unwrap();
    let b=|c:Vector3<f64>,h:Vector3<f64>,free:bool| BodyParameters{name:"b".into(),shape:BodyShape::Box{half_extents_m:h},t_world_body:Isometry3::translation(c.x,c.y,c.z),motion:if free {BodyMotion::Free}else{BodyMotion::Fixed},density_kg_per_m3:0.05/(8.*0.0175*0.01*0.005),friction:0.0};
    let mut r=RigidScene::new(&[b(Vector3::new(0.0175,0.,0.008),Vector3::new(0.0175,0.01,0.005),true),b(Vector3::new(0.0175,0.02,0.008),Vector3::new(0.05,0.01,0.05),false),b(Vector3::new(0.0175,-0.02,0.008),Vector3::new(0.05,0.01,0.05),false)],&Vector3::new(0.,0.,-9.81),1e-3,m.proxy_spheres().len()).unwrap();
    let mut planes=vec![];
    for k in 0..200 { planes.clear(); r.find_contacts(m.proxy_spheres(),2e-4,&mut planes);
        let base=*m.base();
        r.step(&mut m,&ToolDrive{base,tendon:TendonCommand::Force([0.0;2]),tip_wrench:Wrench::zero()},&mut planes).unwrap();
        if k<12 || k%20==0 { let p=r.poses().next().unwrap(); println!("{k} {:?} rot {:?} {:?} v {:?} F {:?} bodyplanes {:?}",p.translation.vector.as_slice(),p.rotation.scaled_axis().as_slice(),r.last_report(),r.velocity(0).unwrap().0.as_slice(), m.contact_results().iter().map(|c|(c.sphere_index,c.normal_force_n)).collect::<Vec<_>>(), planes.iter().enumerate().map(|(i,p)|(p.sphere_index,r.body_of_plane(i).unwrap(),p.gap_m,p.normal.z)).collect::<Vec<_>>()); }
    }
}
