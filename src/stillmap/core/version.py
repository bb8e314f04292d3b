"""The version of the installed package."""


def package_version() -> str:
    """The installed version of stillmap."""
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as installed_version

    try:
        return installed_version("stillmap")
    except PackageNotFoundError:  # run from a source tree that is not installed
        return "0+unknown"
