"""What pyproject.toml cannot say: one wheel serves all interpreters that have a stable ABI; free-threaded ones have none."""

import sysconfig

from setuptools import setup

tag = {} if sysconfig.get_config_var("Py_GIL_DISABLED") else {"py_limited_api": "cp311"}
setup(options={"bdist_wheel": tag})
