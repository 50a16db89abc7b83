use super::*;
#[test]
fn fit() {
    let Ok(list) = std::env::var("FIT") else { return };
    for path in list.split_whitespace() {
        let path = std::path::PathBuf::from(path);
        let read = crate::asset::read_paths(&[path.clone()]).unwrap();
        let dir = path.parent().unwrap().to_owned();
        let side: Vec<(String, std::path::PathBuf)> = read[1..].iter().map(|f| (f.path.clone(), dir.join(&f.path))).collect();
        let side: Vec<(&str, &Path)> = side.iter().map(|(a, b)| (a.as_str(), b.as_path())).collect();
        let t = std::time::Instant::now();
        let e = estimate((&read[0].path, &path), &side, &Limits::default());
        eprintln!("{} {:?} {:?}", path.display(), e, t.elapsed());
    }
}
