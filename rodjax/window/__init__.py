"""The window in which a hand moves a rod: `rodjax.view`, `rodjax view scene.toml`."""
