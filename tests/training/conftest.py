import pytest
import torch


@pytest.fixture(autouse=True)
def torch_as_it_was():
    """Every test begins with the same torch, and must leave its precision as it was: the next one relies on it."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    yield
    torch.set_num_threads(threads)
    assert torch.get_float32_matmul_precision() == "highest"
