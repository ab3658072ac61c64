"""Lets the assertions of shared tests tell what they compared, as those of test files do."""

import pytest

pytest.register_assert_rewrite("executor_contract")
