"""The base tester: every stage of tensorsim inherits it, so that none arrives untested.

A test class names its module and its inputs; the tester checks what every stage
promises: scripted equals eager, batch equals loop, float32 near float64, CPU equals CUDA, gradients against
finite differences, no hidden state, and an exception of ours for bad input.
"""

import io
import warnings
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from tensorsim.errors import TensorsimError


def tensors_of(output: Any) -> list[Tensor]:
    """All tensors of a stage's output (a tensor or a NamedTuple), in order."""
    return [leaf for leaf in pytree.tree_leaves(output) if isinstance(leaf, Tensor)]


def assert_same(actual: Any, expected: Any, rtol: float = 0.0, atol: float = 0.0) -> None:
    """Compare two stage outputs, tensor by tensor; ``atol`` is relative to the peak of each tensor."""
    actual_list, expected_list = tensors_of(actual), tensors_of(expected)
    assert len(actual_list) == len(expected_list)
    for i, (a, e) in enumerate(zip(actual_list, expected_list, strict=True)):
        assert a.shape == e.shape, f"output {i}: shapes {tuple(a.shape)} and {tuple(e.shape)}"
        e = e.to(a.device)
        if a.is_floating_point() or a.is_complex():
            finite = e.abs()[torch.isfinite(e.abs())]
            peak = float(finite.detach().max()) if finite.numel() else 1.0
            e = e.to(a.dtype)
            torch.testing.assert_close(a, e, rtol=rtol, atol=atol * max(peak, 1e-30), equal_nan=True)
        else:
            assert torch.equal(a, e), f"output {i} differs in {(a != e).sum()} of {a.numel()} places"


class StageTester:
    """Inherit, set ``make`` and ``inputs``, and switch off (with a reason beside it) what does not apply."""

    #: Positions of the tensor arguments that carry the leading batch dimension.
    batched_arguments: ClassVar[tuple[int, ...]] = (0,)
    #: Positions of the arguments to differentiate by; empty for stages that are not differentiable.
    gradient_arguments: ClassVar[tuple[int, ...]] = (0,)
    #: Leading shapes to try against the loop; stages that take exactly one batch dimension keep ((3,),).
    batch_shapes: ClassVar[tuple[tuple[int, ...], ...]] = ((3,), (2, 2))
    scripts: ClassVar[bool] = True
    float64: ClassVar[bool] = True
    #: torch.export works with the batch sizes of `inputs` (README has the table).
    exports: ClassVar[bool] = True
    script_atol: ClassVar[float] = 1e-6
    batch_atol: ClassVar[float] = 1e-5
    float32_atol: ClassVar[float] = 1e-4
    cuda_atol: ClassVar[float] = 1e-4
    gradient_atol: ClassVar[float] = 1e-5

    def __init_subclass__(cls, **options: Any) -> None:
        """Leave out the tests of what a stage does not do by design, and those of CUDA where there is none."""
        super().__init_subclass__(**options)
        for name, applies in (
            ("test_scripted_equals_eager", cls.scripts),
            ("test_float32_near_float64", cls.float64),
            ("test_gradients_against_finite_differences", len(cls.gradient_arguments) > 0),
            ("test_exports", cls.exports),
            ("test_cpu_equals_cuda", torch.cuda.is_available()),
        ):
            if not applies and name not in cls.__dict__:
                setattr(cls, name, None)

    def make(self) -> nn.Module:
        """The stage with small, quick settings."""
        raise NotImplementedError

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        """Seeded arguments of forward with these leading dimensions."""
        raise NotImplementedError

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        """Arguments that must be refused, each with a regular expression for the message."""
        raise NotImplementedError

    # ---- what every stage promises -----------------------------------------------------------------

    def test_smoke_and_no_state(self) -> None:
        module, args = self.make(), self.inputs(self.batch_shapes[0], torch.float32)
        before = {k: v.clone() for k, v in module.state_dict().items()}
        copies = pytree.tree_map(lambda x: x.clone() if isinstance(x, Tensor) else x, args)
        with torch.no_grad():
            first, second = module(*args), module(*args)
        assert_same(second, first)
        assert_same(args, copies)
        for key, value in module.state_dict().items():
            assert torch.equal(value, before[key]), f"forward changed {key}"

    def test_batch_equals_loop(self) -> None:
        module = self.make()
        for shape in self.batch_shapes:
            args = self.inputs(shape, torch.float32)
            with torch.no_grad():
                whole = tensors_of(module(*args))
            count = int(torch.tensor(shape).prod())
            for flat in range(count):
                index = tuple(int(i) for i in torch.unravel_index(torch.tensor(flat), shape))
                single = list(args)
                for position in self.batched_arguments:
                    if single[position] is not None:
                        single[position] = args[position][index].unsqueeze(0)
                with torch.no_grad():
                    part = tensors_of(module(*single))
                assert_same([p[0] for p in part], [w[index] for w in whole], atol=self.batch_atol)

    def test_scripted_equals_eager(self) -> None:
        module = self.make()
        scripted = torch.jit.script(module)
        file = io.BytesIO()
        torch.jit.save(scripted, file)
        file.seek(0)
        loaded = torch.jit.load(file)
        for shape in self.batch_shapes:
            args = self.inputs(shape, torch.float32)
            with torch.no_grad():
                expected = module(*args)
                assert_same(scripted(*args), expected, atol=self.script_atol)
                assert_same(loaded(*args), expected, atol=self.script_atol)

    def test_float32_near_float64(self) -> None:
        args64 = self.inputs(self.batch_shapes[0], torch.float64)
        args32 = pytree.tree_map(
            lambda x: x.float() if isinstance(x, Tensor) and x.dtype == torch.float64 else x, args64
        )
        with torch.no_grad():
            assert_same(self.make()(*args32), self.make().double()(*args64), atol=self.float32_atol)

    def test_gradients_against_finite_differences(self) -> None:
        module = self.make().double()
        args = list(self.inputs((1,), torch.float64))
        for position in self.gradient_arguments:
            args[position] = args[position].clone().requires_grad_(True)

        def function(*inputs: Any) -> tuple[Tensor, ...]:
            outputs = tensors_of(module(*inputs))
            return tuple(o for o in outputs if o.requires_grad)

        assert torch.autograd.gradcheck(
            function, tuple(args), fast_mode=True, atol=self.gradient_atol, rtol=1e-3
        )

    def test_exports(self) -> None:
        module = self.make()
        args = self.inputs(self.batch_shapes[0], torch.float32)
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch.export's own deprecation notes
            program = torch.export.export(module, args)
            assert_same(program.module()(*args), module(*args), atol=self.script_atol)

    def test_cpu_equals_cuda(self) -> None:
        module, args = self.make(), self.inputs(self.batch_shapes[0], torch.float32)
        on_gpu = pytree.tree_map(lambda x: x.cuda() if isinstance(x, Tensor) else x, args)
        with torch.no_grad():
            assert_same(self.make().cuda()(*on_gpu), module(*args), atol=self.cuda_atol)

    def test_refuses_bad_input(self) -> None:
        module = self.make()
        for args, message in self.bad_inputs():
            with pytest.raises(TensorsimError, match=message):
                module(*args)
