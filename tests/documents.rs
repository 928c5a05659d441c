//! The documents say what the code says, and their links lead somewhere.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests fail the test")]

use std::path::{Path, PathBuf};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(name: impl AsRef<Path>) -> String {
    let path = root().join(name);
    std::fs::read_to_string(&path).unwrap_or_else(|cause| panic!("{}: {cause}", path.display()))
}

fn documents() -> Vec<PathBuf> {
    let in_docs = std::fs::read_dir(root().join("docs")).unwrap().map(|entry| entry.unwrap().path());
    let pages = in_docs.filter(|path| path.extension().is_some_and(|extension| extension == "md"));
    pages.chain(["README.md", "ARCHITECTURE.md", "CHANGELOG.md"].map(|name| root().join(name))).collect()
}

/// The module documentation of a source file, without its marks.
fn module_doc(source: &str) -> Vec<String> {
    let lines = source.lines().map_while(|line| line.strip_prefix("//!"));
    lines.map(|line| line.trim().to_owned()).filter(|line| !line.is_empty()).collect()
}

/// The `text` blocks of a page, line by line.
fn text_blocks(page: &str) -> Vec<Vec<String>> {
    let blocks = page.split("\n```text\n").skip(1).filter_map(|rest| rest.split("\n```").next());
    blocks.map(|block| block.lines().map(|line| line.trim().to_owned()).collect()).collect()
}

#[test]
fn the_tick_of_the_architecture_is_that_of_the_code() {
    let blocks = text_blocks(&read("ARCHITECTURE.md"));
    for (source, first) in
        [("physics_proc/src/process/mod.rs", "connect:"), ("physics_proc/src/simulation/mod.rs", "1. apply")]
    {
        let block = blocks.iter().find(|block| block[0].starts_with(first));
        let block =
            block.unwrap_or_else(|| panic!("ARCHITECTURE.md has no block that begins with `{first}`"));
        let doc = module_doc(&read(source));
        let found = doc.windows(block.len()).any(|window| window == block);
        assert!(
            found,
            "ARCHITECTURE.md's block from `{first}` is not the module documentation of {source}:\n{doc:#?}"
        );
    }
}

#[test]
fn every_link_of_the_documents_leads_to_a_file() {
    for page in documents() {
        let text = std::fs::read_to_string(&page).unwrap();
        for link in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            let file = link.split('#').next().unwrap_or_default();
            if !file.is_empty() && !link.contains("://") {
                let target = page.parent().unwrap().join(file);
                assert!(target.exists(), "{}: the link `{link}` leads nowhere", page.display());
            }
        }
    }
}

#[test]
fn every_scene_that_the_documents_name_is_there() {
    for page in documents() {
        let text = std::fs::read_to_string(&page).unwrap();
        for rest in text.split("configs/").skip(1) {
            let end = rest
                .find(|c: char| !(c.is_ascii_alphanumeric() || c == '_' || c == '.'))
                .unwrap_or(rest.len());
            let name = rest[..end].trim_end_matches('.');
            assert!(
                root().join("configs").join(name).exists(),
                "{}: no scene configs/{name}",
                page.display()
            );
        }
    }
}
