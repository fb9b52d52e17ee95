use cara_core::Variables;

#[derive(Variables)]
struct Note {
    text: String,
}

fn main() {}
