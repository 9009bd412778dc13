"""Files for `--config` as a user would write them."""
import tomlkit


def config_file(folder, name="config.toml", **values):
    """The path of a file with these values; nested settings are nested dictionaries."""
    path = folder / name
    path.write_text(tomlkit.dumps(values), encoding="utf-8")
    return path
