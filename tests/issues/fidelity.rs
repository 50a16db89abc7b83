//! How near the delivered textures are to the uploaded ones.

use image::{DynamicImage, ImageFormat, RgbImage};
use intarsia::asset::File;
use intarsia::context::Context;
use intarsia::refine::{Input, parse, refine};
use intarsia::texture::{decode, texel};
use serde_json::{Value, json};

/// A picture that JPEG does not hold as it is.
fn picture(side: u32, format: ImageFormat) -> Vec<u8> {
    let wave = |v: f64| (127.5 + 127.5 * v.sin()) as u8;
    let at = |x: u32, y: u32| (f64::from(x), f64::from(y));
    let image = RgbImage::from_fn(side, side, |x, y| {
        let (x, y) = at(x, y);
        image::Rgb([wave(x / 2.3), wave(y / 3.1), wave((x + y) / 1.7)])
    });
    let mut bytes = std::io::Cursor::new(Vec::new());
    DynamicImage::ImageRgb8(image).write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

/// A square on a quarter of a sheet of 128 texels, at a whole texel, with `maps` in its material.
pub(super) fn report(maps: &str, files: &[(&str, Vec<u8>)], options: Value) -> (Value, Vec<(String, Vec<u8>)>) {
    let mut model = "mtllib m.mtl\nusemtl m\n".to_owned();
    for (x, y) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
        model += &format!("v {x} {y} 0\nvt {} {}\n", 0.25 + x / 2.0, 0.25 + y / 2.0);
    }
    model += "f 1/1 2/2 3/3 4/4\n";
    let own = [("m.obj", model.into_bytes()), ("m.mtl", format!("newmtl m\n{maps}").into_bytes())];
    let all = own.iter().chain(files).map(|(path, bytes)| File { path: (*path).to_owned(), bytes: bytes.clone() });
    let input = Input { models: vec![all.collect()], extras: true, ..Input::default() };
    let done = refine(&input, &parse::options(&options).unwrap(), &Context::silent()).unwrap();
    assert_eq!(done.report["outcome"], "refined");
    let textures = done.artifacts.into_iter().filter(|a| a.role == "texture").map(|a| (a.name, a.bytes)).collect();
    (done.report["textures"].clone(), textures)
}

/// The mean squared difference of the delivered square to the uploaded one, texel by texel, in dB. It moved by whole texels, and did not turn.
fn by_hand(uploaded: &[u8], delivered: &[u8]) -> f64 {
    let (old, new) = (decode(uploaded, 1 << 20).unwrap(), decode(delivered, 1 << 20).unwrap());
    let difference = |dx: u32, dy: u32| {
        let mut sum = 0.0;
        for (x, y) in (0..64).flat_map(|x| (0..64).map(move |y| (x, y))) {
            let (a, b) = (texel(&old, 32 + x, 32 + y), texel(&new, x + dx, y + dy));
            sum += (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>();
        }
        sum / (64.0 * 64.0 * 3.0)
    };
    let places = (0..=new.width() - 64).flat_map(|x| (0..=new.height() - 64).map(move |y| (x, y)));
    let least = places.map(|(x, y)| difference(x, y)).fold(f64::INFINITY, f64::min);
    -10.0 * least.log10()
}

/// A JPEG was said to be exact, at 120 dB, and its file showed 50.7 dB: what was measured was never encoded.
#[test]
fn fidelity_is_that_of_the_file_delivered() {
    let jpeg = picture(128, ImageFormat::Jpeg);
    let options = json!({"pack": {"rotation": "none"}, "texture": {"jpeg_quality": 80}});
    let (textures, files) = report("map_Kd a.jpg\n", &[("a.jpg", jpeg.clone())], options);
    let texture = &textures[0];
    assert_eq!((&texture["after"]["format"], &texture["exact"]), (&json!("jpeg"), &json!(false)), "{texture:#}");
    let (told, layout) = (texture["psnr_db"].as_f64().unwrap(), texture["layout_psnr_db"].as_f64());
    assert_eq!((layout, &texture["layout_exact"]), (Some(120.0), &json!(true)), "the layout alone lost nothing");
    assert!((15.0..60.0).contains(&told), "{texture:#}");
    assert!(texture["max_error"].as_f64().unwrap() > 1.0, "{texture:#}");
    // Points between texels are seen through a filter, which smooths some of the loss.
    let found = by_hand(&jpeg, &files[0].1);
    assert!((told - found).abs() < 5.0, "{told} dB is told, {found} dB is what there is");
}

#[test]
fn what_is_written_without_a_loss_stays_exact() {
    for (format, name) in [(ImageFormat::Png, "a.png"), (ImageFormat::Jpeg, "a.jpg")] {
        let files = [(name, picture(128, format))];
        let (textures, _) = report(&format!("map_Kd {name}\n"), &files, json!({"texture": {"format": "png"}}));
        let texture = &textures[0];
        assert_eq!((&texture["exact"], &texture["psnr_db"]), (&json!(true), &json!(120.0)), "{name}: {texture:#}");
        assert_eq!((&texture["layout_exact"], &texture["layout_psnr_db"]), (&json!(true), &Value::Null), "{name}");
    }
}

/// Directions have no decibels, and were said to be exact too.
#[test]
fn normals_that_are_compressed_are_not_exact() {
    let files = [("n.jpg", picture(128, ImageFormat::Jpeg))];
    let (textures, _) = report("norm n.jpg\n", &files, json!({"texture": {"jpeg_quality": 50}}));
    let texture = &textures[0];
    assert_eq!(texture["slot"], "normal", "{texture:#}");
    assert_eq!((&texture["exact"], &texture["layout_exact"]), (&json!(false), &json!(true)), "{texture:#}");
    let angle = |key: &str| texture[key].as_f64().unwrap();
    assert!(angle("angle_p95_deg") > 1.0 && angle("layout_angle_p95_deg") < 0.1, "{texture:#}");
}
