# CalibSLAM on a fresh debian:12:  docker build -f docker/debian.Dockerfile -t calibslam . && docker run --rm calibslam
FROM debian:12

RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        build-essential ca-certificates python3 python3-dev python3-venv \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /calibslam
COPY . .
# Sets everything up, once, in the image.
RUN ./calibslam shell -c true

ENTRYPOINT ["./calibslam"]
CMD ["demo"]
