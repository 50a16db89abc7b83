//! What is written strip by strip is what whole pages give.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::*;
use crate::context::Silent;

/// A page of 1,100 rows is five strips, one of 70 a part of one.
#[test]
fn a_jpeg_in_strips_is_that_of_the_whole_page() {
    for (seed, channels, height) in [(1, 3, 1100), (2, 1, 1100), (3, 3, 70), (4, 3, 259)] {
        let mut random = Random(seed);
        let image = picture(700, 500, channels, false);
        let mut charts = Charts::new([700, 500], [4100, height]);
        for _ in 0..30 {
            let place = DVec2::new(random.range(40.0, 660.0).floor(), random.range(40.0, 460.0).floor());
            let new = DVec2::new(random.range(40.0, 4060.0), random.range(30.0, f64::from(height) - 30.0));
            let (_, to_new) = whole(Turn::ALL[random.below(8) as usize], place, new);
            let points = star(&mut random, place, 30.0);
            charts.fan(0, &points, to_new);
        }
        let role = if seed == 4 { Role::Normal } else { Role::BaseColor };
        let slot = slot(role, &image);
        let job = charts.bake(&slot, &image);
        let context = Context::silent();
        let coding = JpegCoding { decoded: seed != 3, ..JpegCoding::of_quality(85) };
        let baked = bake(&job, &context).unwrap();
        for threads in [1, 3] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let streamed = pool.install(|| bake_jpeg(&job, &coding, 3000, &context)).unwrap().unwrap();
            assert_eq!(streamed.verbatim_texels, baked.verbatim_texels);
            assert_eq!(streamed.files.len(), 1);
            let (size, file) = &streamed.files[0];
            let uploaded = UploadedColors::new(&job, 3000, &context).unwrap();
            assert_eq!(streamed.layout_fidelity, uploaded.against(&baked.pages, &context).unwrap());
            let shown = decode(file, 1 << 23).unwrap();
            assert_eq!(streamed.fidelity, uploaded.against(&[shown], &context).unwrap());
            assert_eq!(*size, [4100, height]);
            assert!(
                *file == encode(&baked.pages[0], &Coding::Jpeg(coding.clone())).unwrap(),
                "{seed} with {threads} threads"
            );
        }
    }
}

#[test]
fn what_is_resampled_or_cancelled_is_not_written_in_strips() {
    let image = picture(300, 300, 3, false);
    let (slot, coding) = (slot(Role::BaseColor, &image), JpegCoding::default());
    let points = [(20.0, 20.0), (200.0, 30.0), (100.0, 250.0)].map(DVec2::from);
    let mut charts = Charts::new([300, 300], [300, 300]);
    charts.fan(0, &points, |p| p + 0.5);
    assert!(bake_jpeg(&charts.bake(&slot, &image), &coding, 100, &Context::silent()).unwrap().is_none());
    let mut charts = Charts::new([300, 300], [300, 300]);
    charts.fan(0, &points, |p| p + 5.0);
    let context = Context::silent();
    assert!(bake_jpeg(&charts.bake(&slot, &image), &coding, 100, &context).unwrap().is_some());
    let cancelled = Context::new(Arc::new(Silent), Arc::new(AtomicBool::new(true)), 0);
    assert!(bake_jpeg(&charts.bake(&slot, &image), &coding, 100, &cancelled).is_err());
}
