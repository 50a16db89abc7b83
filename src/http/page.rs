//! `/` and `/page/{name}`: the page, as it lies in `page/`, and the same page with one job inside as a file of its own.
//!
//! Files are served as they are written, without the indentation. For a file that opens without a server they are put one behind the other, which needs that each
//! imports, by name and on one line, only from those before it; a test holds that.

use std::sync::LazyLock;

use axum::extract::Path;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use serde_json::Value;
use sha2::{Digest, Sha256};

use super::jobs::matches;
use super::problem::{HandlerResult, Problem};
use crate::error::{Code, Failure, Result};

/// What the page may do: run its own files and call its own service, be in no frame, send forms nowhere.
const POLICY: HeaderValue = HeaderValue::from_static(
    "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; object-src 'none'",
);
const STYLE_LINK: &str = "<link rel=\"stylesheet\" href=\"page/style.css\">";
const SCRIPT_LINK: &str = "<script type=\"module\" src=\"page/app.js\"></script>";
const ICON_LINK: &str = "<link rel=\"icon\" href=\"page/icon.svg\" type=\"image/svg+xml\">\n";

/// A file of the page.
struct PageFile {
    name: &'static str,
    media_type: &'static str,
    text: String,
}

macro_rules! page_files {
    ($($name:literal: $media_type:literal,)*) => {
        LazyLock::new(|| vec![$(PageFile { name: $name, media_type: $media_type, text: plain(include_str!(concat!("page/", $name))) },)*])
    };
}

/// A file without indentation, which nothing in it needs.
fn plain(source: &str) -> String {
    source.lines().flat_map(|line| [line.trim_start(), "\n"]).collect()
}

/// All files; modules behind those that they import.
static FILES: LazyLock<Vec<PageFile>> = page_files! {
    "index.html": "text/html; charset=utf-8",
    "style.css": "text/css; charset=utf-8",
    "icon.svg": "image/svg+xml",
    "dom.js": "text/javascript; charset=utf-8",
    "colours.js": "text/javascript; charset=utf-8",
    "preview.js": "text/javascript; charset=utf-8",
    "raster.js": "text/javascript; charset=utf-8",
    "view2d.js": "text/javascript; charset=utf-8",
    "view3d.js": "text/javascript; charset=utf-8",
    "viewer.js": "text/javascript; charset=utf-8",
    "verdict.js": "text/javascript; charset=utf-8",
    "files.js": "text/javascript; charset=utf-8",
    "options.js": "text/javascript; charset=utf-8",
    "api.js": "text/javascript; charset=utf-8",
    "app.js": "text/javascript; charset=utf-8",
};

/// The ETag of each file.
static ETAGS: LazyLock<Vec<String>> = LazyLock::new(|| {
    let tag = |file: &PageFile| format!("\"{}\"", hex::encode(&Sha256::digest(&file.text)[..16]));
    FILES.iter().map(tag).collect()
});

/// The page: drop a model, follow its job, see what was won. `/?job=ID` is that of a job.
#[utoipa::path(get, path = "/", tag = "page", responses(
    (status = 200, description = "The page", content_type = "text/html", body = String, example = json!("<!doctype html>")),
    (status = 304, description = "The client has it")))]
pub(super) async fn index(headers: HeaderMap) -> HandlerResult {
    file("index.html", &headers)
}

/// A file that the page consists of.
#[utoipa::path(get, path = "/page/{name}", tag = "page",
    params(("name" = String, Path, description = "Name of the file", example = "app.js")), responses(
    (status = 200, description = "The file", content_type = "text/javascript", body = String, example = json!("export {};")),
    (status = 304, description = "The client has it"),
    (status = 404, description = "The page has no such file", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn part(Path(name): Path<String>, headers: HeaderMap) -> HandlerResult {
    file(&name, &headers)
}

fn file(name: &str, headers: &HeaderMap) -> HandlerResult {
    let found = FILES.iter().zip(ETAGS.iter()).find(|(file, _)| file.name == name);
    let (file, etag) = found.ok_or_else(|| Problem::new(Code::NotFound, "the page has no such file"))?;
    let mut response: Response = match matches(headers, etag) {
        true => StatusCode::NOT_MODIFIED.into_response(),
        false => ([(header::CONTENT_TYPE, file.media_type)], file.text.as_str()).into_response(),
    };
    let told = response.headers_mut();
    let own = HeaderValue::from_str(etag).map_err(|e| Failure::internal(e.to_string()))?;
    told.insert(header::ETAG, own);
    told.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    told.insert(header::CONTENT_SECURITY_POLICY, POLICY);
    told.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    told.insert(header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    told.insert(header::X_FRAME_OPTIONS, HeaderValue::from_static("DENY"));
    let opener = HeaderName::from_static("cross-origin-opener-policy");
    told.insert(opener, HeaderValue::from_static("same-origin"));
    Ok(response)
}

/// The page of a job as one file, which needs neither a service nor the network: the report and the preview are inside.
///
/// # Errors
/// `internal` where the page is not made as it should be.
pub fn standalone(report: &Value, preview: &[u8]) -> Result<String> {
    let text = |name: &str| FILES.iter().find(|file| file.name == name).map_or("", |file| file.text.as_str());
    let script = one_module();
    let style = text("style.css");
    let hash = |text: &str| BASE64.encode(Sha256::digest(text));
    let policy = format!(
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; script-src 'sha256-{}'; style-src 'sha256-{}'\">",
        hash(&script),
        hash(style)
    );
    // Nothing in the data can end the element that it stands in.
    let report = report.to_string().replace('<', "\\u003c");
    let data = format!(
        "<script type=\"application/json\" id=\"report-data\">{report}</script>\n<script type=\"text/plain\" id=\"preview-data\">{}</script>\n",
        BASE64.encode(preview)
    );
    let parts = [
        (ICON_LINK, String::new()),
        (STYLE_LINK, format!("{policy}\n<style>{style}</style>")),
        (SCRIPT_LINK, String::new()),
        ("</body>", format!("{data}<script type=\"module\">{script}</script>\n</body>")),
    ];
    let mut page = text("index.html").to_owned();
    for (old, new) in parts {
        let at = page.find(old).ok_or_else(|| Failure::internal(format!("the page has no {old}")))?;
        page.replace_range(at..at + old.len(), &new);
    }
    Ok(page)
}

/// All modules as one.
fn one_module() -> String {
    let mut out = String::new();
    for file in FILES.iter().filter(|file| file.name.ends_with(".js")) {
        for line in file.text.lines().filter(|line| !line.starts_with("import ")) {
            out.push_str(line.strip_prefix("export ").unwrap_or(line));
            out.push('\n');
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    /// What a page takes to load: the bound that the project sets itself.
    const MAX_BYTES: usize = 120_000;

    /// Names and sources, indented as they are written.
    fn modules() -> impl Iterator<Item = (&'static str, String)> {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src/http/page");
        let scripts = FILES.iter().filter(|file| file.name.ends_with(".js"));
        scripts.map(move |file| (file.name, std::fs::read_to_string(folder.join(file.name)).unwrap()))
    }

    #[test]
    fn the_page_is_small() {
        let bytes: usize = FILES.iter().map(|file| file.text.len()).sum();
        assert!(bytes < MAX_BYTES, "{bytes} bytes");
    }

    #[test]
    fn modules_can_be_put_one_behind_the_other() {
        let (mut before, mut names) = (BTreeSet::new(), BTreeSet::new());
        for (module, text) in modules() {
            for line in text.lines() {
                if line.starts_with("import ") {
                    let from = line.split_once(" from \"./").and_then(|(_, rest)| rest.strip_suffix("\";"));
                    assert!(line.contains('{') && !line.contains(" as "), "{module}: {line}");
                    assert!(from.is_some_and(|from| before.contains(from)), "{module}: {line}");
                }
                let plain = line.strip_prefix("export ").unwrap_or(line);
                let plain = plain.strip_prefix("async ").unwrap_or(plain);
                let named = ["function ", "const ", "let ", "class "].iter().find_map(|kind| plain.strip_prefix(kind));
                if let Some(named) = named {
                    let name = named.split(|c: char| !c.is_alphanumeric() && c != '_').next().unwrap();
                    assert!(names.insert(name.to_owned()), "{module}: two modules declare {name:?}");
                }
                assert!(!line.contains("</script"), "{module}: {line}");
            }
            before.insert(module);
        }
        assert!(names.len() > 40, "the declarations were not found: {}", names.len());
    }

    #[test]
    fn nothing_in_the_data_of_a_file_runs() {
        let page = standalone(&serde_json::json!({ "name": "</script><script>alert(1)</script>" }), b"INTP").unwrap();
        assert!(!page.contains("alert(1)</script>"));
        assert!(
            page.contains("script-src 'sha256-") && !page.contains("page/app.js") && !page.contains("page/style.css")
        );
        assert_eq!(page.matches("<script type=\"module\">").count(), 1);
    }

    #[tokio::test]
    async fn files_have_a_tag_and_a_strict_policy() {
        let first = index(HeaderMap::new()).await.unwrap();
        let policy = first.headers()[header::CONTENT_SECURITY_POLICY].to_str().unwrap();
        assert!(policy.starts_with("default-src 'self'") && !policy.contains("unsafe") && !policy.contains("blob:"));
        let tag = first.headers()[header::ETAG].clone();
        let known = HeaderMap::from_iter([(header::IF_NONE_MATCH, tag.clone())]);
        let again = index(known.clone()).await.unwrap();
        assert_eq!((again.status(), &again.headers()[header::ETAG]), (StatusCode::NOT_MODIFIED, &tag));
        assert_eq!(part(Path("app.js".to_owned()), known).await.unwrap().status(), StatusCode::OK);
        assert!(part(Path("../page.rs".to_owned()), HeaderMap::new()).await.is_err());
    }
}
