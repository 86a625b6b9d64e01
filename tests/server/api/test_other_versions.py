"""What other versions of Trompe left behind, or will have, in the same database and files."""

from trompe_shared.api import JobState


def test_a_result_that_this_version_does_not_understand_is_told_and_not_lost(stocked):
    own, foreign = stocked.job(labels={"experiment": "e"}), stocked.job(seed=1, labels={"experiment": "e"})
    stocked.end(foreign, result__json=b'{"glitter": 3}')
    html = {"Accept": "text/html"}
    page = stocked.get(f"/jobs/{foreign}", headers=html)
    assert page.status_code == 200
    assert "Another version of Trompe wrote the result" in page.text
    assert f'href="/v1/jobs/{foreign}/archive"' in page.text
    assert stocked.get(f"/v1/jobs/{foreign}/artifacts/result.json").content == b'{"glitter": 3}'
    assert "Another version" not in stocked.get(f"/jobs/{own}", headers=html).text
    several = stocked.get("/experiments/e", headers=html)
    assert (several.status_code, foreign in several.text) == (200, True)
    compared = stocked.get(f"/jobs/compare?a={foreign}&b={own}", headers=html)
    assert (compared.status_code, "a result of another version" in compared.text) == (404, True)


def test_what_was_taken_when_less_was_refused_stays_as_it_was_and_is_taken_again(stocked):
    """Options without effect are refused today; a queue may still hold jobs with them."""
    old = stocked.job()
    spec = stocked.get(f"/v1/jobs/{old}").json()["spec"] | {"azimuths": 2, "optimiser": "auto", "alpha": 0.02}
    assert stocked.submit(azimuths=2).status_code == stocked.submit(optimiser="auto", alpha=0.02).status_code == 422
    stocked.tell(old, "from before", spec=spec)
    shown = stocked.get(f"/v1/jobs/{old}").json()
    assert (shown["spec"], shown["note"]) == (spec, None)
    stocked.end(old, JobState.failed)
    again = stocked.post(f"/v1/jobs/{old}/retry")
    assert (again.status_code, again.json()["spec"]) == (201, spec)


def test_a_job_that_is_not_understood_is_not_repeated_as_another_one(stocked):
    job = stocked.job()
    spec = stocked.get(f"/v1/jobs/{job}").json()["spec"]
    stocked.tell(job, "from another version", spec=spec | {"glitter": 3})
    stocked.end(job, JobState.failed)
    assert "options ['glitter']" in stocked.problem(stocked.post(f"/v1/jobs/{job}/retry"), 409)["detail"]
    assert len(stocked.get("/v1/jobs").json()["jobs"]) == 1
