//! Writes `docs/scenarios.md`.

use cara_scenarios::table;

fn main() -> std::io::Result<()> {
    std::fs::write(table::path(), table::text())
}
