"""Check of query parameters: FastAPI ignores those that a route does not have."""

from difflib import get_close_matches

from fastapi import Request

from trompe_shared.errors import SpecError


async def refuse_unknown(request: Request) -> None:
    """Raise ``SpecError`` for a query parameter that the route does not have."""
    known = [parameter.alias for parameter in request.scope["route"].dependant.query_params]
    for name in request.query_params:
        if name not in known:
            close = get_close_matches(name, known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"{request.url.path} takes {', '.join(known) or 'none'}."
            raise SpecError(f"Unknown query parameter {name!r}; {hint}")
