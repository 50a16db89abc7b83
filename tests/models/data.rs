//! Where the real models are.

use std::path::PathBuf;

use intarsia::asset::File;
use intarsia::asset::read_paths;

/// Those of authored glTF and of scans that packing must master.
pub const MODELS: [&str; 13] = [
    "pbr/khr_Avocado/Avocado.gltf",
    "pbr/khr_WaterBottle/WaterBottle.gltf",
    "pbr/khr_BoomBoxWithAxes/BoomBoxWithAxes.gltf",
    "pbr/khr_Suzanne/Suzanne.gltf",
    "pbr/khr_Duck/Duck.glb",
    "pbr/khr_CesiumMan/CesiumMan.glb",
    "pbr/khr_Monster/Monster.glb",
    "pbr/khr_AnimatedCube/AnimatedCube.gltf",
    "pbr/draco_Fox/Fox.gltf",
    "pbr/khr_NormalTangentTest/NormalTangentTest.glb",
    "scans/meshroom_esp32cam/texturedMesh.obj",
    "scans/planeopt_copyroom/copyroom_c2000_opt.obj",
    "scans/ycb_025_mug/textured.obj",
];

/// The folder of models, if there is one.
pub fn folder() -> Option<PathBuf> {
    let folder = std::env::var_os("INTARSIA_DATA")
        .map(PathBuf::from)
        .unwrap_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"));
    folder.is_dir().then_some(folder)
}

/// The files of a model; `None`, aloud, where it is missing.
pub fn model(name: &str) -> Option<Vec<File>> {
    let path = folder()?.join(name);
    match read_paths(&[path]) {
        Ok(files) => Some(files),
        Err(_) => {
            println!("skipped: {name} is not at hand");
            None
        }
    }
}

/// Every model of the list that is at hand; says aloud when there is none.
pub fn models() -> Vec<(&'static str, Vec<File>)> {
    if folder().is_none() {
        println!("skipped: no models at hand (set INTARSIA_DATA)");
    }
    MODELS.iter().filter_map(|name| Some((*name, model(name)?))).collect()
}
