"""Builds the optional C++ shim; everything else about the project is in pyproject.toml."""

from setuptools import Extension, setup

setup(
    ext_modules=[
        Extension(
            "harness.worlds._shim",
            ["harness/worlds/shim.cpp"],
            language="c++",
            extra_compile_args=["-O2", "-std=c++17"],
            libraries=["dl"],
            optional=True,  # without a compiler the harness is complete, only slower
        )
    ]
)
