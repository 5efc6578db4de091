# The package with its training, on CPUs alone; .ci/docker builds and tries it. Runs are kept in a volume:
#   docker build -t multilift_marl . && docker run --rm -v multilift_runs:/home/multilift/app/runs multilift_marl
FROM python:3.11-slim-bookworm

# For videos: OpenGL without a display.
RUN apt-get update \
 && apt-get install -y --no-install-recommends libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri \
 && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home --uid 1000 multilift
USER multilift
WORKDIR /home/multilift/app
ENV VIRTUAL_ENV=/home/multilift/venv PATH=/home/multilift/venv/bin:$PATH PIP_NO_CACHE_DIR=1
RUN python -m venv "$VIRTUAL_ENV" && mkdir runs

# PyTorch first, as long as its version stays: without CUDA, which the package does not need.
COPY --chown=multilift constraints.txt .
RUN pip install --no-deps --index-url https://download.pytorch.org/whl/cpu -c constraints.txt torch

COPY --chown=multilift . .
# Of the tag, since the history is left out; without it the version is the fallback of pyproject.toml.
ARG VERSION=
RUN SETUPTOOLS_SCM_PRETEND_VERSION="$VERSION" pip install -c constraints.txt -e ".[train]" \
 && python -c "import torch; assert torch.version.cuda is None, torch.__version__"

CMD ["python", "train.py", "config=quickstart"]
